"""One fit, or one set of pictures, on several processes: MPI.

Imported where a command was started by ``mpiexec``, and by nobody else.
"""
