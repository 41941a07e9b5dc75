"""The interface between the web process and the workers: job kinds, parameters, phases, errors and identities."""
