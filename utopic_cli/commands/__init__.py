"""The commands: options in, a library call, files and a summary out."""
