/* The pendulum's functions for batches of states. */
#define FB_LANES
#include "hand_written_pendulum.c"
