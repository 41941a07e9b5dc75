"""The message queue that passes job ids from the web process to the workers."""
