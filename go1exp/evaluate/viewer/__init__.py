"""A simulated robot in the browser, commanded while it runs; recordings and results of ``go1exp gap``.

``session.py`` and ``replay.py`` are plain classes that know no browser; ``web.py`` shows them by MuJoCo Studio's web
viewer, and its panels draw their content and send the user's requests (``requests.py``).
"""
