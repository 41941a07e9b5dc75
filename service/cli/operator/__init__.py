"""The commands for operators: `database`, `store`, `key` and `doctor`."""
