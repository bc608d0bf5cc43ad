"""What stands above the tasks: ranking in the task, pages, pictures, benchmarks."""
