"""Routes for operation: health, metrics, and the API page."""
