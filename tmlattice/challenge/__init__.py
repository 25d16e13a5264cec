"""The blind challenge: the diagnosis checked on data whose cause is withheld."""
