"""The queue of job ids between the web process and the workers."""
