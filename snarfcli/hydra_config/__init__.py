"""The configuration of commands: their dataclasses as Hydra's schemas, the yaml files in conf/, and checks of overrides."""
