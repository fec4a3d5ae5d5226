"""What pictures and fits leave out, measured (`python -m studies.leave_out`)."""
