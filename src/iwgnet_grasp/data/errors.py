class DataError(RuntimeError):
    """A data file or folder that cannot be used; the message says which, where and why."""
