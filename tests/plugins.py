"""Plugins for tests, of names and where their classes are."""

from acwm_core.hooks import hookimpl


def plugin_of(**components):
    """What an entry point names: ``plugin_of(codecs={"blocks": "module:Blocks"})``."""

    def hook(targets):
        def register(registry):
            for name, target in targets.items():
                registry.add(name, target)

        return staticmethod(hookimpl(register))

    hooks = {f"register_{kinds}": hook(targets) for kinds, targets in components.items()}
    return type("Plugin", (), hooks)
