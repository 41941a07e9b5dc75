"""Plots of images and PSFs, and the HTML page of reports."""
