"""The method: projection, tiles, compositing, and the adjoint of each."""
