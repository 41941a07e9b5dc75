"""Point-spread functions of solar imagers: building, applying and removing them."""
