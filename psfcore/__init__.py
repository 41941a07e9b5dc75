"""Point-spread functions of solar imagers: heliopsf computes and fits them, and deconvolves images with them."""
