"""What the web process and the workers agree on: job kinds, parameters, phases, errors and identities."""
