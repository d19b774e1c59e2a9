"""The command line: flags become Hydra overrides, help texts, messages for user errors."""
