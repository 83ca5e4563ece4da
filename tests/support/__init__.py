"""Code that tests share: scenes, small fits and captures, mutants."""
