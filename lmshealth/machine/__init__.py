"""Assessment of one machine: verdict, service, next step, notices, status and summary."""
