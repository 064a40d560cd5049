"""What people see of a deployment: a page, served by a process that can never delay control."""
