/* The functions of FMI 2.0 for model exchange and co-simulation; see export/fmu.h. */
#ifndef FOURBAR_FMI2_H
#define FOURBAR_FMI2_H

#include "fmu.h"

#if defined(_WIN32)
#define FMI2_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI2_EXPORT __attribute__((visibility("default")))
#else
#define FMI2_EXPORT
#endif

/* As the standard defines them. */
typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean, fmi2Integer;
typedef double fmi2Real;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
    fmi2Boolean newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged;
    fmi2Boolean valuesOfContinuousStatesChanged, nextEventTimeDefined;
    fmi2Real nextEventTime;
} fmi2EventInfo;
typedef void (*fmi2CallbackLogger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
typedef struct {
    fmi2CallbackLogger logger;
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

static fmi2Status fmu_status(const int succeeds)
{
    return succeeds ? fmi2OK : fmi2Error;
}

static void fmu_write(fmu *f, const int is_error, const char *text)
{
    const fmi2CallbackLogger log = (fmi2CallbackLogger)f->callback;
    char format[1024]; /* some importers show the format alone; a percent sign is doubled in it */
    size_t n = 0;
    for (; *text && n + 2 < sizeof format; ++text) {
        format[n++] = *text;
        if (*text == '%')
            format[n++] = '%';
    }
    format[n] = '\0';
    if (log && (is_error || f->logs))
        log(f->environment, f->name, is_error ? fmi2Error : fmi2OK, is_error ? "logStatusError" : "logEvents", format);
}

FMI2_EXPORT const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

FMI2_EXPORT const char *fmi2GetVersion(void)
{
    return "2.0";
}

FMI2_EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component instance, fmi2Boolean on, size_t n,
                                           const fmi2String categories[])
{
    fmu *const f = instance;
    (void)n;
    (void)categories;
    if (f == NULL)
        return fmi2Error;
    f->logs = on;
    return fmi2OK;
}

FMI2_EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token, fmi2String resources,
                                          const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logs)
{
    fmu *const f = fmu_new(name, token, type == fmi2CoSimulation);
    (void)resources;
    (void)visible;
    if (f == NULL) {
        if (functions && functions->logger)
            functions->logger(functions->componentEnvironment, name, fmi2Error, "logStatusError",
                              "The GUID is another one: binary and model description are of different models.");
        return NULL;
    }
    f->logs = logs;
    if (functions) {
        f->environment = functions->componentEnvironment;
        f->callback = (void (*)(void))functions->logger;
    }
    f->write = fmu_write;
    fmu_reset(f);
    return f;
}

FMI2_EXPORT void fmi2FreeInstance(fmi2Component instance)
{
    fmu_free(instance);
}

FMI2_EXPORT fmi2Status fmi2SetupExperiment(fmi2Component instance, fmi2Boolean has_tolerance, fmi2Real tolerance,
                                           fmi2Real begin, fmi2Boolean has_end, fmi2Real end)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2SetupExperiment", FMU_INSTANTIATED) ||
        !fmu_begin(f, begin, has_tolerance, tolerance, has_end, end))
        return fmi2Error;
    f->state.mode = FMU_INSTANTIATED;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component instance)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2EnterInitializationMode", FMU_INSTANTIATED) &&
                      fmu_begin(f, f->state.model.t, 0, 0.0, 0, 0.0));
}

FMI2_EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2ExitInitializationMode", FMU_INITIALIZATION) || !fmu_close(f))
        return fmi2Error;
    f->state.mode = f->state.is_cosimulation ? FMU_STEP : FMU_EVENT;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2Terminate(fmi2Component instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2Terminate", FMU_INITIALIZED))
        return fmi2Error;
    f->state.mode = FMU_TERMINATED;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2Reset(fmi2Component instance)
{
    if (instance == NULL)
        return fmi2Error;
    fmu_reset(instance);
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2GetReal(fmi2Component instance, const fmi2ValueReference references[], size_t n,
                                   fmi2Real values[])
{
    fmu *const f = instance;
    return fmu_status(
        fmu_may(f, "fmi2GetReal", FMU_INSTANTIATED | FMU_INITIALIZATION | FMU_INITIALIZED | FMU_TERMINATED) &&
        fmu_get(f, references, n, values));
}

FMI2_EXPORT fmi2Status fmi2SetReal(fmi2Component instance, const fmi2ValueReference references[], size_t n,
                                   const fmi2Real values[])
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2SetReal", FMU_INSTANTIATED | FMU_INITIALIZATION | FMU_INITIALIZED) &&
                      fmu_set(f, references, n, values));
}

#define FB_OTHER_TYPE(name)                                                                                            \
    FMI2_EXPORT fmi2Status fmi2Get##name(fmi2Component instance, const fmi2ValueReference references[], size_t n,      \
                                         fmi2##name values[])                                                          \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)values;                                                                                                  \
        return fmu_status(fmu_lacks_type(instance, n, #name));                                                         \
    }                                                                                                                  \
    FMI2_EXPORT fmi2Status fmi2Set##name(fmi2Component instance, const fmi2ValueReference references[], size_t n,      \
                                         const fmi2##name values[])                                                    \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)values;                                                                                                  \
        return fmu_status(fmu_lacks_type(instance, n, #name));                                                         \
    }

FB_OTHER_TYPE(Integer)
FB_OTHER_TYPE(Boolean)
FB_OTHER_TYPE(String)

FMI2_EXPORT fmi2Status fmi2GetFMUstate(fmi2Component instance, fmi2FMUstate *saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_save(f, saved));
}

FMI2_EXPORT fmi2Status fmi2SetFMUstate(fmi2Component instance, fmi2FMUstate saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_restore(f, saved));
}

FMI2_EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component instance, fmi2FMUstate *saved)
{
    (void)instance;
    if (saved) {
        free(*saved);
        *saved = NULL;
    }
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component instance, fmi2FMUstate saved, size_t *size)
{
    (void)saved;
    if (instance == NULL || size == NULL)
        return fmi2Error;
    *size = sizeof(fmu_record);
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component instance, fmi2FMUstate saved, fmi2Byte bytes[], size_t size)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_serialize(f, saved, bytes, size));
}

FMI2_EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component instance, const fmi2Byte bytes[], size_t size,
                                               fmi2FMUstate *saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_deserialize(f, bytes, size, saved));
}

FMI2_EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component instance, const fmi2ValueReference unknowns[],
                                                    size_t n_unknowns, const fmi2ValueReference knowns[],
                                                    size_t n_knowns, const fmi2Real seed[], fmi2Real sensitivity[])
{
    fmu *const f = instance;
    return fmu_status(
        fmu_may(f, "fmi2GetDirectionalDerivative", FMU_INITIALIZATION | FMU_INITIALIZED | FMU_TERMINATED) &&
        fmu_directional_derivative(f, unknowns, n_unknowns, knowns, n_knowns, seed, sensitivity));
}

FMI2_EXPORT fmi2Status fmi2EnterEventMode(fmi2Component instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2EnterEventMode", FMU_CONTINUOUS | FMU_EVENT))
        return fmi2Error;
    f->state.mode = FMU_EVENT;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component instance, fmi2EventInfo *info)
{
    fmu *const f = instance;
    int changed = 0, defined = 0;
    if (!fmu_may(f, "fmi2NewDiscreteStates", FMU_EVENT) ||
        !fmu_handle_event(f, &changed, &defined, &info->nextEventTime))
        return fmi2Error;
    info->newDiscreteStatesNeeded = info->nominalsOfContinuousStatesChanged = 0;
    info->terminateSimulation = f->state.is_over;
    info->valuesOfContinuousStatesChanged = changed;
    info->nextEventTimeDefined = defined;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2EnterContinuousTimeMode", FMU_EVENT))
        return fmi2Error;
    f->state.mode = FMU_CONTINUOUS;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component instance, fmi2Boolean no_set, fmi2Boolean *enter_event,
                                                   fmi2Boolean *terminate)
{
    fmu *const f = instance;
    (void)no_set;
    if (!fmu_may(f, "fmi2CompletedIntegratorStep", FMU_CONTINUOUS))
        return fmi2Error;
    *enter_event = fmu_is_open(f);
    if (!fmu_note_signs(f, 0))
        return fmi2Error;
    *terminate = f->state.is_over;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2SetTime(fmi2Component instance, fmi2Real t)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2SetTime", FMU_EVENT | FMU_CONTINUOUS) && fmu_set_time(f, t));
}

FMI2_EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component instance, const fmi2Real states[], size_t n)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2SetContinuousStates", FMU_CONTINUOUS) && fmu_set_states(f, states, n));
}

FMI2_EXPORT fmi2Status fmi2GetDerivatives(fmi2Component instance, fmi2Real derivatives[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2GetDerivatives", FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n) || !fmu_close(f))
        return fmi2Error;
    return fmu_rates(f, derivatives) ? fmi2OK : fmi2Discard; /* the importer may try a shorter step */
}

FMI2_EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component instance, fmi2Real indicators[], size_t n)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2GetEventIndicators", FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS) &&
                      fmu_get_indicators(f, indicators, n));
}

FMI2_EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component instance, fmi2Real states[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2GetContinuousStates", FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n) || !fmu_close(f))
        return fmi2Error;
    memcpy(states, f->state.model.x, N_X * sizeof *states);
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component instance, fmi2Real nominals[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi2GetNominalsOfContinuousStates",
                 FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n))
        return fmi2Error;
    for (size_t i = 0; i < n; ++i)
        nominals[i] = 1.0;
    return fmi2OK;
}

/* Inputs that change linearly in the next step of co-simulation. */
static int fmu_set_slopes(fmu *f, const unsigned *references, const size_t n, const int *orders, const double *values)
{
    struct FB_MODEL *const m = &f->state.model;
    for (size_t i = 0; i < n; ++i) {
        if (references[i] < OF_INPUTS || references[i] >= OF_RESULTS)
            return fmu_fail(f, "The variable with the value reference %u is no input.", references[i]);
        if (orders[i] != 1 || !isfinite(values[i]))
            return fmu_fail(f, "An input has a finite derivative of order 1, not %g of order %d.", values[i],
                            orders[i]);
        if (!m->held[references[i] - OF_INPUTS])
            return fmu_fail(f, "The input with the value reference %u has no value yet.", references[i]);
        m->slope[references[i] - OF_INPUTS] = values[i];
    }
    m->since = m->t;
    f->state.valid = 0;
    return 1;
}

FMI2_EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component instance, const fmi2ValueReference references[],
                                                   size_t n, const fmi2Integer orders[], const fmi2Real values[])
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi2SetRealInputDerivatives", FMU_INITIALIZATION | FMU_STEP) &&
                      fmu_set_slopes(f, references, n, orders, values));
}

FMI2_EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component instance, const fmi2ValueReference references[],
                                                    size_t n, const fmi2Integer orders[], fmi2Real values[])
{
    (void)references;
    (void)n;
    (void)orders;
    (void)values;
    return fmu_status(fmu_lacks(instance, "derivatives of outputs"));
}

FMI2_EXPORT fmi2Status fmi2DoStep(fmi2Component instance, fmi2Real begin, fmi2Real length, fmi2Boolean no_set)
{
    fmu *const f = instance;
    double reached;
    (void)no_set;
    if (!fmu_may(f, "fmi2DoStep", FMU_STEP))
        return fmi2Error;
    const int taken = fmu_step(f, begin, length, &reached);
    if (taken > 0 && f->state.is_over)
        return fmi2Discard; /* the importer asks for fmi2Terminated, and for the time reached */
    return taken > 0 ? fmi2OK : taken < 0 ? fmi2Discard : fmi2Error;
}

FMI2_EXPORT fmi2Status fmi2CancelStep(fmi2Component instance)
{
    return fmu_status(fmu_lacks(instance, "asynchronous steps"));
}

FMI2_EXPORT fmi2Status fmi2GetStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)kind;
    (void)value;
    return fmu_status(fmu_lacks(instance, "asynchronous steps"));
}

FMI2_EXPORT fmi2Status fmi2GetRealStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Real *value)
{
    fmu *const f = instance;
    if (f == NULL || kind != fmi2LastSuccessfulTime)
        return fmu_status(fmu_lacks(instance, "this status"));
    *value = f->state.model.t;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Integer *value)
{
    (void)kind;
    (void)value;
    return fmu_status(fmu_lacks(instance, "this status"));
}

FMI2_EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2Boolean *value)
{
    fmu *const f = instance;
    if (f == NULL || kind != fmi2Terminated)
        return fmu_status(fmu_lacks(instance, "this status"));
    *value = f->state.mode == FMU_TERMINATED || f->state.is_over;
    return fmi2OK;
}

FMI2_EXPORT fmi2Status fmi2GetStringStatus(fmi2Component instance, const fmi2StatusKind kind, fmi2String *value)
{
    (void)kind;
    (void)value;
    return fmu_status(fmu_lacks(instance, "asynchronous steps"));
}

#endif
