"""The files of a data set, and what reads them."""
