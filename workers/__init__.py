"""Jobs: their contract, catalogue, files, queue and the tasks that run the physics."""
