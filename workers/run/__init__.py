"""Workers: processes that take jobs from the queues and run them."""
