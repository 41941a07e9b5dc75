"""HTTP: the application, the client and the command line."""
