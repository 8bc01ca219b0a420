"""The interactive viewer.

``server``, ``panel``, ``crop_panel``, ``export_panel``, ``controls`` and ``notifications`` use viser; nothing else here does.
"""
