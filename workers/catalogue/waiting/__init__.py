"""The order in which waiting jobs start, and completed jobs that are queued again."""
