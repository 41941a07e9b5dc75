"""What every HTTP interface of the service shares: callers, limits, errors, uploads and downloads."""
