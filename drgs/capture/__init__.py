"""Turn a Mitsuba scene into a training set."""
