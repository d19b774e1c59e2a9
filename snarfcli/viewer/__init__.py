"""The avatar in the browser: what is shown is decided here, viser only shows it."""
