"""A fit, or a set of images, on several processes: MPI.

Imported where a command was started by ``mpiexec``, and by nobody else.
"""
