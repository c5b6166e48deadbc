"""Jobs (train, propose, export, import), each in a worker process. One runs at a time, the others wait."""
