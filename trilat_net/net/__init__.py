"""Exchanges messages between the processes of a session over the network.

A session is a run in which several processes each control one robot arm, while others record
the messages or let people take part.

The package contains the network connection (`bus`, `zenoh_bus`, `connection`, `member_keys`),
the messages and their encoding (`messages`, `requests`, `wire`, `topics`), the clocks and their
comparison (`clock`, `pinging`, `offset`, `timing`), and the agreement of the processes on the
start of a session (`membership`, `session`, `discovery`). Programs outside a session connect
with `arm_client`, `known_sites` and `ros2_graph`.
"""
