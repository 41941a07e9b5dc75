"""The gap report: its JSON form (schema gap/1), its HTML page and its figures."""
