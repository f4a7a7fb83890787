/* Public names of a model's C library, which begin with that of the model, FB_MODEL. */
#ifndef FOURBAR_PUBLIC_NAMES_H
#define FOURBAR_PUBLIC_NAMES_H

#define FB_JOINED(model, name) model##_##name
#define FB_NAMED(model, name) FB_JOINED(model, name)
#define FB_PUBLIC(name) FB_NAMED(FB_MODEL, name)
#define FB_EVENT FB_PUBLIC(event)
#define FB_FOUND FB_PUBLIC(found)
#define FB_EVENTS FB_PUBLIC(events)

#endif
