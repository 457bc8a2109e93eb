"""The command line: a module for each verb; what a user can mend is a ``SlamError`` of one line, from any of them."""
