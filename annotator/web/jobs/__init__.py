"""Jobs (train, propose, export, import ...), each in a worker process, in two lanes."""
