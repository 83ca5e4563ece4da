"""Array types, constants, errors, files and LLVM: what everything else stands on.

Imports nothing of drgs.
"""
