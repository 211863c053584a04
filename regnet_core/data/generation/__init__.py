"""Makes a data set: settings, workers, scenes."""
