"""Stand-ins of a second family: described as bodies, joints, motors and contacts, and moved by a rigid-body engine."""
