"""What a worker process does (benchmarks/worker.py): each task is one kind of measurement."""
