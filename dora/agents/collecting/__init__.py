"""From tasks to batches: the TorchRL environment and the worker processes that roll policies out."""
