"""Array types, constants, errors, files and LLVM: the lowest layer.

Imports nothing of drgs.
"""
