"""The browser view: what files and folders have to show, and the server of ``igsr view --web``."""
