"""The interactive viewer.

``server``, ``panel``, ``take_away`` and ``talk`` speak to viser; everything else here knows nothing of it.
"""
