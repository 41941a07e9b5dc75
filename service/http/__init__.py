"""Code that all HTTP interfaces of the service share: callers, limits, errors, uploads and downloads."""
