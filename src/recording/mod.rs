//! Data sets: robot kinematics, rendering new recordings, reading and writing them.
