"""A fit, or a set of images, on several processes: MPI."""
