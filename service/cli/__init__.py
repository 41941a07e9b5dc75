"""The command line. Most files contain one command or one group of commands; `main` lists all commands."""
