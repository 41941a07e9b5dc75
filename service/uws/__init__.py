"""The IVOA UWS 1.1 interface."""
