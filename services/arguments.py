"""The error of an argument whose value is not allowed, where argparse itself cannot tell."""


class WrongArgument(ValueError):
    """The command line ends with exit code 1."""
