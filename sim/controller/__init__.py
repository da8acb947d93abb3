"""A simulated UR controller: a process that an unmodified client of the real one connects to.

`server` owns the sockets, `robot` the arm and its modes, `program` does what the client's script
asks for, `motion` says where the arm is on its way, `surroundings` whether it runs into something,
and `camera` takes depth frames from where the arm truly is.
"""
