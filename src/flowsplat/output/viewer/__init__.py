"""The interactive viewer.

``server``, ``panel``, ``export_panel`` and ``notifications`` use viser; nothing else here does.
"""
