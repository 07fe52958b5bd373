# The Rust core as Python sees it. One section per room, in the order of the flow.
__version__: str

def set_threads(threads: int | None = None) -> None: ...
