"""What browsers are sent: the job page, and the viewer."""
