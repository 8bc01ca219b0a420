"""Provide what every package uses: errors for people, atomic files, progress, devices."""
