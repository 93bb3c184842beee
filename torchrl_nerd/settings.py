"""Settings of a configuration class that are out of range."""


class SettingError(ValueError):
    """Says in one sentence which setting was given and what was expected."""


def expect_at_least(least: float, **settings: float) -> None:
    """Refuse settings below ``least``.

    Raises:
        SettingError: naming the first such setting.
    """
    for name, value in settings.items():
        if value < least:
            raise SettingError(f"expected {name} of at least {least}, got {value}")
