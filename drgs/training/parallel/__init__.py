"""A fit, or a set of images, on several processes: MPI.

Imported only where a command was started by ``mpiexec``.
"""
