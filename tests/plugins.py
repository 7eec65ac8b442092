"""What comes from elsewhere: plugins of names and where their classes are, and an attack."""

import os

from acwm_core.plugins import hookimpl


def plugin_of(**components):
    """What an entry point names: ``plugin_of(codecs={"blocks": "module:Blocks"})``."""

    def hook(targets):
        def register(registry):
            for name, target in targets.items():
                registry.add(name, target)

        return staticmethod(hookimpl(register))

    hooks = {f"register_{kinds}": hook(targets) for kinds, targets in components.items()}
    return type("Plugin", (), hooks)


class Attack:
    """Makes the file `mark` when it is unpickled by a loader that trusts it."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)
