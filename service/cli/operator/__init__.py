"""The commands of an operator: database, store, keys, and `doctor`."""
