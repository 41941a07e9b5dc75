"""The commands for operators: `cache`, `database`, `doctor`, `key` and `store`."""
