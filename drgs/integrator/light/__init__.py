"""Surfaces among splats and light between the two, on Mitsuba's side; imported on demand."""
