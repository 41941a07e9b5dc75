"""The gap report: as JSON (schema gap/1), as an HTML page, and as figures."""
