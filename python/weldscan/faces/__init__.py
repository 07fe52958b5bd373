"""The faces: what people and programs use weldscan through."""
