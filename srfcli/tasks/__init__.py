"""What `srf` can do, one function for each command: values in, a result out; nothing is printed or written."""
