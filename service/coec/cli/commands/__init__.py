"""What each command takes, a module each; what it does is in the module of its name, imported when it is called."""
