"""What needs rospy: messages <-> values, and the session that runs the graph."""
