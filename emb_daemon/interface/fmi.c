/* FMI 3.0 co-simulation over the estimator's C header.
 *
 * variables.h is made with the FMU: EMB_TOKEN, and the table of variables by value reference. Unless fmi3Functions.h was included
 * before, the part of it that is needed is declared here.
 */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>

#include "emb.h"

#define EXPORT __attribute__((visibility("default")))

#ifndef fmi3Functions_h
typedef void *fmi3Instance, *fmi3InstanceEnvironment, *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef double fmi3Float64;
typedef int64_t fmi3Int64;
typedef bool fmi3Boolean;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment, fmi3Status, fmi3String, fmi3String);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment, fmi3Float64, fmi3Boolean, fmi3Boolean, fmi3Boolean,
                                               fmi3Boolean, fmi3Boolean *, fmi3Float64 *);
#endif

enum phase { INSTANTIATED, INITIALIZATION, STEP, TERMINATED };
enum kind { TIME, FLOAT64, INT64, BOOLEAN };
enum role { INDEPENDENT, PARAMETER, INPUT, OUTPUT };

/* What a simulation may keep and restore. */
typedef struct {
    enum phase phase;
    double time;
    bool has_sample;
    int64_t cycle, since_sample; /* cycles since the first sample and since the last one */
    emb_brake brake;
    emb_sample sample;
    emb_estimate estimate;
} model;

typedef struct {
    model model;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} instance;

typedef struct {
    enum kind kind;
    enum role role;
    size_t offset; /* in a model */
} variable;

#include "variables.h"

static fmi3Status fail(instance *self, const char *format, ...) {
    if (self->log) {
        char text[200];
        va_list arguments;
        va_start(arguments, format);
        vsnprintf(text, sizeof text, format, arguments);
        va_end(arguments);
        self->log(self->environment, fmi3Error, "logStatusError", text);
    }
    return fmi3Error;
}

static void start(model *m) {
    memset(m, 0, sizeof *m);
    emb_init(&m->brake, &emb_calibration);
    m->sample = start_sample;
    m->estimate.source = EMB_SOURCE_INVALID;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)i, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                                fmi3Boolean logging, fmi3Boolean event_mode, fmi3Boolean early_return,
                                                const fmi3ValueReference required[], size_t number,
                                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                                fmi3IntermediateUpdateCallback update) {
    (void)name, (void)resources, (void)visible, (void)logging, (void)event_mode, (void)early_return, (void)required;
    (void)number, (void)update;
    instance refused = {.environment = environment, .log = log};
    if (!token || strcmp(token, EMB_TOKEN) != 0) {
        fail(&refused, "instantiationToken: expected %s", EMB_TOKEN);
        return NULL;
    }
    instance *self = malloc(sizeof *self);
    if (self) {
        *self = refused;
        start(&self->model);
    }
    return self;
}

EXPORT void fmi3FreeInstance(fmi3Instance i) { free(i); }

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean tolerance_defined, fmi3Float64 tolerance,
                                              fmi3Float64 start_time, fmi3Boolean stop_defined, fmi3Float64 stop_time) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop_time;
    instance *self = i;
    self->model.time = start_time;
    self->model.phase = INITIALIZATION;
    return fmi3OK;
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance i) {
    ((instance *)i)->model.phase = STEP;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance i) {
    ((instance *)i)->model.phase = TERMINATED;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance i) {
    start(&((instance *)i)->model);
    return fmi3OK;
}

/* The place of a variable that may be set or read now; NULL, and a message, if there is none of that kind. */
static void *find(instance *self, fmi3ValueReference reference, enum kind kind, bool set) {
    if (reference >= sizeof variables / sizeof *variables || variables[reference].kind != kind) {
        fail(self, "value reference %u: no variable of that type", (unsigned)reference);
        return NULL;
    }
    const variable *v = &variables[reference];
    if (set && v->role != INPUT && (v->role != PARAMETER || self->model.phase > INITIALIZATION)) {
        fail(self, "value reference %u: %s", (unsigned)reference,
             v->role == PARAMETER ? "a parameter is fixed once initialization is over" : "is an output");
        return NULL;
    }
    return (char *)&self->model + v->offset;
}

#define ACCESS(Name, KIND)                                                                                                  \
    EXPORT fmi3Status fmi3Get##Name(fmi3Instance i, const fmi3ValueReference references[], size_t count,                    \
                                    fmi3##Name values[], size_t number) {                                                   \
        for (size_t k = 0; k < count; k++) {                                                                                \
            const void *place = k < number ? find(i, references[k], KIND, false) : NULL;                                    \
            if (!place)                                                                                                     \
                return fmi3Error;                                                                                           \
            memcpy(&values[k], place, sizeof *values);                                                                      \
        }                                                                                                                   \
        return fmi3OK;                                                                                                      \
    }                                                                                                                       \
    EXPORT fmi3Status fmi3Set##Name(fmi3Instance i, const fmi3ValueReference references[], size_t count,                    \
                                    const fmi3##Name values[], size_t number) {                                             \
        for (size_t k = 0; k < count; k++) {                                                                                \
            void *place = k < number ? find(i, references[k], KIND, true) : NULL;                                           \
            if (!place)                                                                                                     \
                return fmi3Error;                                                                                           \
            memcpy(place, &values[k], sizeof *values);                                                                      \
        }                                                                                                                   \
        return fmi3OK;                                                                                                      \
    }

ACCESS(Float64, FLOAT64)
ACCESS(Int64, INT64)
ACCESS(Boolean, BOOLEAN)

/* The inputs are the sample at the beginning of the step; the outputs at its end are the estimate from it. */
EXPORT fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 time, fmi3Float64 size, fmi3Boolean no_return, fmi3Boolean *event,
                             fmi3Boolean *terminate, fmi3Boolean *early_return, fmi3Float64 *last_time) {
    (void)no_return;
    instance *self = i;
    model *m = &self->model;
    *event = *terminate = *early_return = false;
    *last_time = time;
    double cycles = round(size / EMB_CYCLE_S);
    /* Simulators add steps up: what they leave of a cycle is rounding. */
    if (!(cycles >= 1.0 && cycles < 1e9 && fabs(size / EMB_CYCLE_S - cycles) < 1e-6))
        return fail(self, "communicationStepSize %g s: expected a multiple of %g s", size, EMB_CYCLE_S);

    emb_sample *sample = &m->sample;
    sample->time_ns = llround(1e9 * time);
    sample->cycle = m->cycle;
    sample->age_cycles = sample->is_prediction ? m->since_sample : 0;
    sample->dt = m->has_sample ? (double)m->since_sample * EMB_CYCLE_S : 0.0;
    if (emb_step(&m->brake, sample, &m->estimate) != 0)
        return fail(self, "the estimator failed");
    if (!sample->is_prediction) {
        m->has_sample = true;
        m->since_sample = 0;
    }
    m->cycle += (int64_t)cycles;
    m->since_sample += (int64_t)cycles;
    sample->elapsed_cycles = (int64_t)cycles;
    m->time = *last_time = time + size;
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) {
    if (!*state && !(*state = malloc(sizeof(model))))
        return fail(i, "no memory");
    memcpy(*state, &((instance *)i)->model, sizeof(model));
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) {
    memcpy(&((instance *)i)->model, state, sizeof(model));
    return fmi3OK;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) {
    (void)i;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *size) {
    (void)i, (void)state;
    *size = sizeof(model);
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (size != sizeof(model))
        return fail(i, "a state has %zu bytes", sizeof(model));
    memcpy(bytes, state, size);
    return fmi3OK;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    if (size != sizeof(model))
        return fail(i, "a state has %zu bytes", sizeof(model));
    if (!*state && !(*state = malloc(size)))
        return fail(i, "no memory");
    memcpy(*state, bytes, size);
    return fmi3OK;
}

#ifndef fmi3Functions_h
/* What FMI wants to be there although modelDescription.xml says that it cannot be used. */
#define NO_INSTANCE(name)                                                                                                   \
    EXPORT fmi3Instance name(void) { return NULL; }
#define UNSUPPORTED(name)                                                                                                   \
    EXPORT fmi3Status name(void) { return fmi3Error; }

NO_INSTANCE(fmi3InstantiateModelExchange)
NO_INSTANCE(fmi3InstantiateScheduledExecution)
UNSUPPORTED(fmi3EnterEventMode)
UNSUPPORTED(fmi3GetFloat32)
UNSUPPORTED(fmi3GetInt8)
UNSUPPORTED(fmi3GetUInt8)
UNSUPPORTED(fmi3GetInt16)
UNSUPPORTED(fmi3GetUInt16)
UNSUPPORTED(fmi3GetInt32)
UNSUPPORTED(fmi3GetUInt32)
UNSUPPORTED(fmi3GetUInt64)
UNSUPPORTED(fmi3GetString)
UNSUPPORTED(fmi3GetBinary)
UNSUPPORTED(fmi3GetClock)
UNSUPPORTED(fmi3SetFloat32)
UNSUPPORTED(fmi3SetInt8)
UNSUPPORTED(fmi3SetUInt8)
UNSUPPORTED(fmi3SetInt16)
UNSUPPORTED(fmi3SetUInt16)
UNSUPPORTED(fmi3SetInt32)
UNSUPPORTED(fmi3SetUInt32)
UNSUPPORTED(fmi3SetUInt64)
UNSUPPORTED(fmi3SetString)
UNSUPPORTED(fmi3SetBinary)
UNSUPPORTED(fmi3SetClock)
UNSUPPORTED(fmi3GetNumberOfVariableDependencies)
UNSUPPORTED(fmi3GetVariableDependencies)
UNSUPPORTED(fmi3GetDirectionalDerivative)
UNSUPPORTED(fmi3GetAdjointDerivative)
UNSUPPORTED(fmi3EnterConfigurationMode)
UNSUPPORTED(fmi3ExitConfigurationMode)
UNSUPPORTED(fmi3GetIntervalDecimal)
UNSUPPORTED(fmi3GetIntervalFraction)
UNSUPPORTED(fmi3GetShiftDecimal)
UNSUPPORTED(fmi3GetShiftFraction)
UNSUPPORTED(fmi3SetIntervalDecimal)
UNSUPPORTED(fmi3SetIntervalFraction)
UNSUPPORTED(fmi3SetShiftDecimal)
UNSUPPORTED(fmi3SetShiftFraction)
UNSUPPORTED(fmi3EvaluateDiscreteStates)
UNSUPPORTED(fmi3UpdateDiscreteStates)
UNSUPPORTED(fmi3EnterContinuousTimeMode)
UNSUPPORTED(fmi3CompletedIntegratorStep)
UNSUPPORTED(fmi3SetTime)
UNSUPPORTED(fmi3SetContinuousStates)
UNSUPPORTED(fmi3GetContinuousStateDerivatives)
UNSUPPORTED(fmi3GetEventIndicators)
UNSUPPORTED(fmi3GetContinuousStates)
UNSUPPORTED(fmi3GetNominalsOfContinuousStates)
UNSUPPORTED(fmi3GetNumberOfEventIndicators)
UNSUPPORTED(fmi3GetNumberOfContinuousStates)
UNSUPPORTED(fmi3EnterStepMode)
UNSUPPORTED(fmi3GetOutputDerivatives)
UNSUPPORTED(fmi3ActivateModelPartition)
#endif
