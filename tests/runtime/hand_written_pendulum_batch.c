/* The pendulum's functions for several states side by side. */
#define FB_SIDE_BY_SIDE
#include "hand_written_pendulum.c"
