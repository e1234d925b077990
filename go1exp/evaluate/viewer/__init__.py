"""A robot in the browser, driven while it runs; recordings and answers of ``go1exp gap`` in the same window.

``session.py`` and ``replay.py`` are plain classes that know no browser; ``web.py`` shows them by MuJoCo Studio's web
viewer, and the panels beside it draw what they hold and send what a user asks for (``requests.py``).
"""
