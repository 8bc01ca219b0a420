"""What every room uses: errors for people, atomic files, progress, devices."""
