"""Applications: what people do with a run, or before one."""
