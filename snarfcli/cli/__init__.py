"""The command line: flags become Hydra overrides; help, and messages for user errors."""
