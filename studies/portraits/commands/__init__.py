"""The commands of `python -m studies.portraits`, a module each: its docstring is the command's help, `add_arguments`
describes the options, `run` does the work."""
