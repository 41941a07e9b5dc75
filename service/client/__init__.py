"""A client of the service for scripts, over HTTP."""
