// Empty: the command line includes the headers.
