"""Code that several pages share: curves with their tables, and forms that start jobs."""
