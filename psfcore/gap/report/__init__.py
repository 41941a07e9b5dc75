"""The gap report: as JSON (schema gap/2), as an HTML page, and as figures."""
