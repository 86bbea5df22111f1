"""One function per command: arguments in, result out."""
