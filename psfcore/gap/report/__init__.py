"""The gap report: as JSON (schema gap/3), as an HTML page, and as figures."""
