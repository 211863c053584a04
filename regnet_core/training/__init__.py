"""Training of the networks on data sets made by ``regnet generate``."""
