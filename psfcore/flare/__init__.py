"""Stray light of flares: measures diffraction arms, and compares PSFs along them."""
