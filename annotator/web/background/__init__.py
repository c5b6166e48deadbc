"""What a server does beside requests: watches the log, learns, makes backups and returns memory."""
