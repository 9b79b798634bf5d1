"""The kind of error that a user can mend."""


class UserError(ValueError):
    """Something the user gave is wrong. The message says the rule, what was got and what is valid, in one line.

    Configurations do not raise it while they are made but when LeRobot asks them for something: draccus, which makes
    them from a command line, would swallow the message.
    """
