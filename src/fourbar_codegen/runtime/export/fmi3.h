/* The functions of FMI 3.0 for model exchange and co-simulation; see export/fmu.h. */
#ifndef FOURBAR_FMI3_H
#define FOURBAR_FMI3_H

#include "fmu.h"

#include <stdbool.h>
#include <stdint.h>

#if defined(_WIN32)
#define FMI3_EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define FMI3_EXPORT __attribute__((visibility("default")))
#else
#define FMI3_EXPORT
#endif

/* As the standard defines them. */
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef bool fmi3Boolean, fmi3Clock;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3Independent, fmi3Constant, fmi3Fixed, fmi3Tunable, fmi3Discrete, fmi3Dependent } fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, double, fmi3Boolean, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean *, double *);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);

static fmi3Status fmu_status(const int succeeds)
{
    return succeeds ? fmi3OK : fmi3Error;
}

static void fmu_write(fmu *f, const int is_error, const char *text)
{
    const fmi3LogMessageCallback log = (fmi3LogMessageCallback)f->callback;
    if (log && (is_error || f->logs))
        log(f->environment, is_error ? fmi3Error : fmi3OK, is_error ? "logStatusError" : "logEvents", text);
}

FMI3_EXPORT const char *fmi3GetVersion(void)
{
    return "3.0";
}

FMI3_EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n,
                                           const fmi3String categories[])
{
    fmu *const f = instance;
    (void)n;
    (void)categories;
    if (f == NULL)
        return fmi3Error;
    f->logs = on;
    return fmi3OK;
}

static fmi3Instance instantiated(fmi3String name, fmi3String token, fmi3Boolean logs,
                                 fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                 const int is_cosimulation)
{
    fmu *const f = fmu_new(name, token, is_cosimulation);
    if (f == NULL) {
        if (log)
            log(environment, fmi3Error, "logStatusError",
                "The instantiation token is another one: binary and model description are of different models.");
        return NULL;
    }
    f->logs = logs;
    f->environment = environment;
    f->callback = (void (*)(void))log;
    f->write = fmu_write;
    fmu_reset(f);
    return f;
}

FMI3_EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                                      fmi3Boolean visible, fmi3Boolean logs,
                                                      fmi3InstanceEnvironment environment, fmi3LogMessageCallback log)
{
    (void)resources;
    (void)visible;
    return instantiated(name, token, logs, environment, log, 0);
}

FMI3_EXPORT fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                                     fmi3Boolean visible, fmi3Boolean logs, fmi3Boolean event_mode,
                                                     fmi3Boolean early_return, const fmi3ValueReference required[],
                                                     size_t n_required, fmi3InstanceEnvironment environment,
                                                     fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    (void)resources;
    (void)visible;
    (void)event_mode;
    (void)required;
    (void)n_required;
    (void)update;
    fmu *const f = instantiated(name, token, logs, environment, log, 1);
    if (f)
        f->returns_early = early_return;
    return f;
}

FMI3_EXPORT fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                           fmi3Boolean visible, fmi3Boolean logs,
                                                           fmi3InstanceEnvironment environment,
                                                           fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
                                                           fmi3LockPreemptionCallback lock,
                                                           fmi3UnlockPreemptionCallback unlock)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logs;
    (void)update;
    (void)lock;
    (void)unlock;
    if (log)
        log(environment, fmi3Error, "logStatusError", "There is no scheduled execution.");
    return NULL;
}

FMI3_EXPORT void fmi3FreeInstance(fmi3Instance instance)
{
    fmu_free(instance);
}

FMI3_EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean has_tolerance, double tolerance,
                                                   double begin, fmi3Boolean has_end, double end)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi3EnterInitializationMode", FMU_INSTANTIATED) &&
                      fmu_begin(f, begin, has_tolerance, tolerance, has_end, end));
}

FMI3_EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3ExitInitializationMode", FMU_INITIALIZATION) || !fmu_close(f))
        return fmi3Error;
    f->state.mode = f->state.is_cosimulation ? FMU_STEP : FMU_EVENT;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3EnterEventMode", FMU_CONTINUOUS))
        return fmi3Error;
    f->state.mode = FMU_EVENT;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3Terminate(fmi3Instance instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3Terminate", FMU_INITIALIZED))
        return fmi3Error;
    f->state.mode = FMU_TERMINATED;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3Reset(fmi3Instance instance)
{
    if (instance == NULL)
        return fmi3Error;
    fmu_reset(instance);
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                      double values[], size_t n_values)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3GetFloat64", FMU_INSTANTIATED | FMU_INITIALIZATION | FMU_INITIALIZED | FMU_TERMINATED))
        return fmi3Error;
    if (n != n_values)
        return fmu_status(fmu_fail(f, "There are %d variables, but %d values.", (int)n, (int)n_values));
    return fmu_status(fmu_get(f, references, n, values));
}

FMI3_EXPORT fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                      const double values[], size_t n_values)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3SetFloat64", FMU_INSTANTIATED | FMU_INITIALIZATION | FMU_INITIALIZED))
        return fmi3Error;
    if (n != n_values)
        return fmu_status(fmu_fail(f, "There are %d variables, but %d values.", (int)n, (int)n_values));
    return fmu_status(fmu_set(f, references, n, values));
}

#define FB_OTHER_TYPE(name, type)                                                                                      \
    FMI3_EXPORT fmi3Status fmi3Get##name(fmi3Instance instance, const fmi3ValueReference references[], size_t n,       \
                                         type values[], size_t n_values)                                               \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)values;                                                                                                  \
        (void)n_values;                                                                                                \
        return fmu_status(fmu_lacks_type(instance, n, #name));                                                         \
    }                                                                                                                  \
    FMI3_EXPORT fmi3Status fmi3Set##name(fmi3Instance instance, const fmi3ValueReference references[], size_t n,       \
                                         const type values[], size_t n_values)                                         \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)values;                                                                                                  \
        (void)n_values;                                                                                                \
        return fmu_status(fmu_lacks_type(instance, n, #name));                                                         \
    }

FB_OTHER_TYPE(Float32, float)
FB_OTHER_TYPE(Int8, int8_t)
FB_OTHER_TYPE(UInt8, uint8_t)
FB_OTHER_TYPE(Int16, int16_t)
FB_OTHER_TYPE(UInt16, uint16_t)
FB_OTHER_TYPE(Int32, int32_t)
FB_OTHER_TYPE(UInt32, uint32_t)
FB_OTHER_TYPE(Int64, int64_t)
FB_OTHER_TYPE(UInt64, uint64_t)
FB_OTHER_TYPE(Boolean, fmi3Boolean)
FB_OTHER_TYPE(String, fmi3String)

FMI3_EXPORT fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                     size_t sizes[], fmi3Binary values[], size_t n_values)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)n_values;
    return fmu_status(fmu_lacks_type(instance, n, "Binary"));
}

FMI3_EXPORT fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                     const size_t sizes[], const fmi3Binary values[], size_t n_values)
{
    (void)references;
    (void)sizes;
    (void)values;
    (void)n_values;
    return fmu_status(fmu_lacks_type(instance, n, "Binary"));
}

FMI3_EXPORT fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                    fmi3Clock values[])
{
    (void)references;
    (void)values;
    return fmu_status(fmu_lacks_type(instance, n, "Clock"));
}

FMI3_EXPORT fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                    const fmi3Clock values[])
{
    (void)references;
    (void)values;
    return fmu_status(fmu_lacks_type(instance, n, "Clock"));
}

FMI3_EXPORT fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance, fmi3ValueReference reference,
                                                           size_t *n)
{
    (void)reference;
    (void)n;
    return fmu_status(fmu_lacks(instance, "dependencies of single elements"));
}

FMI3_EXPORT fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
                                                   size_t elements[], fmi3ValueReference independents[],
                                                   size_t of_independents[], fmi3DependencyKind kinds[], size_t n)
{
    (void)dependent;
    (void)elements;
    (void)independents;
    (void)of_independents;
    (void)kinds;
    (void)n;
    return fmu_status(fmu_lacks(instance, "dependencies of single elements"));
}

FMI3_EXPORT fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_save(f, saved));
}

FMI3_EXPORT fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_restore(f, saved));
}

FMI3_EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *saved)
{
    (void)instance;
    if (saved) {
        free(*saved);
        *saved = NULL;
    }
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState saved, size_t *size)
{
    (void)saved;
    if (instance == NULL || size == NULL)
        return fmi3Error;
    *size = sizeof(fmu_record);
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState saved, fmi3Byte bytes[], size_t size)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_serialize(f, saved, bytes, size));
}

FMI3_EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                               fmi3FMUState *saved)
{
    fmu *const f = instance;
    return fmu_status(f && saved && fmu_deserialize(f, bytes, size, saved));
}

FMI3_EXPORT fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                                    size_t n_unknowns, const fmi3ValueReference knowns[],
                                                    size_t n_knowns, const double seed[], size_t n_seed,
                                                    double sensitivity[], size_t n_sensitivity)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3GetDirectionalDerivative", FMU_INITIALIZATION | FMU_INITIALIZED | FMU_TERMINATED))
        return fmi3Error;
    if (n_seed != n_knowns || n_sensitivity != n_unknowns)
        return fmu_status(fmu_fail(f, "The seed has %d entries for %d knowns, the result %d for %d unknowns.",
                                   (int)n_seed, (int)n_knowns, (int)n_sensitivity, (int)n_unknowns));
    return fmu_status(fmu_directional_derivative(f, unknowns, n_unknowns, knowns, n_knowns, seed, sensitivity));
}

FMI3_EXPORT fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                                size_t n_unknowns, const fmi3ValueReference knowns[], size_t n_knowns,
                                                const double seed[], size_t n_seed, double sensitivity[],
                                                size_t n_sensitivity)
{
    (void)unknowns;
    (void)n_unknowns;
    (void)knowns;
    (void)n_knowns;
    (void)seed;
    (void)n_seed;
    (void)sensitivity;
    (void)n_sensitivity;
    return fmu_status(fmu_lacks(instance, "adjoint derivatives"));
}

FMI3_EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance)
{
    return fmu_status(fmu_lacks(instance, "a configuration mode"));
}

FMI3_EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance)
{
    return fmu_status(fmu_lacks(instance, "a configuration mode"));
}

#define FB_WITHOUT_CLOCKS(name, ...)                                                                                   \
    FMI3_EXPORT fmi3Status fmi3##name(fmi3Instance instance, const fmi3ValueReference references[], size_t n,          \
                                      __VA_ARGS__)                                                                     \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)n;                                                                                                       \
        (void)first;                                                                                                   \
        (void)second;                                                                                                  \
        return fmu_status(fmu_lacks(instance, "clocks"));                                                              \
    }
#define FB_WITHOUT_CLOCKS_1(name, type)                                                                                \
    FMI3_EXPORT fmi3Status fmi3##name(fmi3Instance instance, const fmi3ValueReference references[], size_t n,          \
                                      type values[])                                                                   \
    {                                                                                                                  \
        (void)references;                                                                                              \
        (void)n;                                                                                                       \
        (void)values;                                                                                                  \
        return fmu_status(fmu_lacks(instance, "clocks"));                                                              \
    }

FB_WITHOUT_CLOCKS(GetIntervalDecimal, double first[], fmi3IntervalQualifier second[])
FB_WITHOUT_CLOCKS(GetShiftFraction, uint64_t first[], uint64_t second[])
FB_WITHOUT_CLOCKS(SetIntervalFraction, const uint64_t first[], const uint64_t second[])
FB_WITHOUT_CLOCKS(SetShiftFraction, const uint64_t first[], const uint64_t second[])
FB_WITHOUT_CLOCKS_1(GetShiftDecimal, double)
FB_WITHOUT_CLOCKS_1(SetIntervalDecimal, const double)
FB_WITHOUT_CLOCKS_1(SetShiftDecimal, const double)

FMI3_EXPORT fmi3Status fmi3GetIntervalFraction(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                               uint64_t counters[], uint64_t resolutions[],
                                               fmi3IntervalQualifier qualifiers[])
{
    (void)references;
    (void)n;
    (void)counters;
    (void)resolutions;
    (void)qualifiers;
    return fmu_status(fmu_lacks(instance, "clocks"));
}

FMI3_EXPORT fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clock, double t)
{
    (void)clock;
    (void)t;
    return fmu_status(fmu_lacks(instance, "clocks"));
}

FMI3_EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    return fmu_status(fmu_may(instance, "fmi3EvaluateDiscreteStates", FMU_INITIALIZATION | FMU_EVENT));
}

FMI3_EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *need_update, fmi3Boolean *terminate,
                                                fmi3Boolean *nominals_changed, fmi3Boolean *values_changed,
                                                fmi3Boolean *has_next, double *next)
{
    fmu *const f = instance;
    int changed = 0, defined = 0;
    if (!fmu_may(f, "fmi3UpdateDiscreteStates", FMU_EVENT) || !fmu_handle_event(f, &changed, &defined, next))
        return fmi3Error;
    *need_update = *nominals_changed = false;
    *terminate = f->state.is_over;
    *values_changed = changed;
    *has_next = defined;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3EnterContinuousTimeMode", FMU_EVENT))
        return fmi3Error;
    f->state.mode = FMU_CONTINUOUS;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance, fmi3Boolean no_set, fmi3Boolean *enter_event,
                                                   fmi3Boolean *terminate)
{
    fmu *const f = instance;
    (void)no_set;
    if (!fmu_may(f, "fmi3CompletedIntegratorStep", FMU_CONTINUOUS))
        return fmi3Error;
    *enter_event = fmu_is_open(f);
    if (!fmu_note_signs(f, 0))
        return fmi3Error;
    *terminate = f->state.is_over;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3SetTime(fmi3Instance instance, double t)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi3SetTime", FMU_EVENT | FMU_CONTINUOUS) && fmu_set_time(f, t));
}

FMI3_EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const double states[], size_t n)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi3SetContinuousStates", FMU_CONTINUOUS) && fmu_set_states(f, states, n));
}

FMI3_EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, double derivatives[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3GetContinuousStateDerivatives",
                 FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n) || !fmu_close(f))
        return fmi3Error;
    return fmu_rates(f, derivatives) ? fmi3OK : fmi3Discard; /* the importer may try a shorter step */
}

FMI3_EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance instance, double indicators[], size_t n)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi3GetEventIndicators", FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS) &&
                      fmu_get_indicators(f, indicators, n));
}

FMI3_EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance instance, double states[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3GetContinuousStates", FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n) || !fmu_close(f))
        return fmi3Error;
    memcpy(states, f->state.model.x, N_X * sizeof *states);
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, double nominals[], size_t n)
{
    fmu *const f = instance;
    if (!fmu_may(f, "fmi3GetNominalsOfContinuousStates",
                 FMU_INITIALIZATION | FMU_EVENT | FMU_CONTINUOUS | FMU_TERMINATED) ||
        !fmu_has_states(f, n))
        return fmi3Error;
    for (size_t i = 0; i < n; ++i)
        nominals[i] = 1.0;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n)
{
    if (instance == NULL || n == NULL)
        return fmi3Error;
    *n = FMU_N_EVENTS;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n)
{
    if (instance == NULL || n == NULL)
        return fmi3Error;
    *n = N_X;
    return fmi3OK;
}

FMI3_EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    fmu *const f = instance;
    return fmu_status(fmu_may(f, "fmi3EnterStepMode", FMU_STEP));
}

FMI3_EXPORT fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance, const fmi3ValueReference references[], size_t n,
                                                const int32_t orders[], double values[], size_t n_values)
{
    (void)references;
    (void)n;
    (void)orders;
    (void)values;
    (void)n_values;
    return fmu_status(fmu_lacks(instance, "derivatives of outputs"));
}

FMI3_EXPORT fmi3Status fmi3DoStep(fmi3Instance instance, double begin, double length, fmi3Boolean no_set,
                                  fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early,
                                  double *reached)
{
    fmu *const f = instance;
    (void)no_set;
    *event_needed = *terminate = *early = false;
    if (!fmu_may(f, "fmi3DoStep", FMU_STEP) || fmu_step(f, begin, length, reached) <= 0)
        return fmi3Error;
    *terminate = f->state.is_over;
    *early = f->returns_early && *reached < begin + length;
    return fmi3OK;
}

#endif
