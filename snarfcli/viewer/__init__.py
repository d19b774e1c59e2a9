"""View an avatar in the browser with viser."""
