"""A task that runs in real time and can be watched: a session without a browser, and a web page that shows it."""
