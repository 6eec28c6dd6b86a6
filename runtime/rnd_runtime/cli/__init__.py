"""What commands share: exit codes, options and help, progress, locks. A library does not need this package."""
