"""The laboratory in software: it answers on the wire and on the CAN bus as hardware would."""

if not __name__.startswith("petrobot."):
    # Found as a folder on the path: its classes would exist twice, and the two would not be equal.
    raise ModuleNotFoundError(
        f"{__name__} is a part of petrobot: import petrobot.{__name__}", name=__name__
    )
