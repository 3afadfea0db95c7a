// Nothing: the headers come from the command line.
