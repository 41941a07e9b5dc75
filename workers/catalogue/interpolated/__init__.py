"""Series whose PSFs may be interpolated in time."""
