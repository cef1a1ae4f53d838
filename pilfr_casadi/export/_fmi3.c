/* The functions of FMI 3.0; functions of other interfaces and types than co-simulation of doubles return an error. */
typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef uint32_t fmi3ValueReference;
typedef const char *fmi3String;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(void *, fmi3Status, fmi3String, fmi3String);

#define REFERENCES const fmi3ValueReference vr[], size_t n
#define NOT_SUPPORTED(c, n) ((n) == 0 ? fmi3OK : (report(c, "The FMU has no such function or variable."), fmi3Error))

static void report(void *instance, const char *message) {
  model_t *m = instance;
  if (m->logger) ((fmi3LogMessageCallback)m->logger)(m->environment, fmi3Error, "logStatusError", message);
}

static fmi3Status status(int failed) { return failed ? fmi3Error : fmi3OK; }

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance c, bool on, size_t n, const fmi3String categories[]) {
  return fmi3OK;
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, bool visible,
                                                bool on, bool events, bool early, REFERENCES,
                                                fmi3InstanceEnvironment environment, fmi3LogMessageCallback logger,
                                                void (*intermediate)(void)) {
  return make(name, token, report, environment, (void (*)(void))logger);
}
EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, bool visible,
                                                 bool on, fmi3InstanceEnvironment environment,
                                                 fmi3LogMessageCallback logger) {
  return NULL;
}
EXPORT fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                                      bool visible, bool on, fmi3InstanceEnvironment environment,
                                                      fmi3LogMessageCallback logger, void (*update)(void),
                                                      void (*lock)(void), void (*unlock)(void)) {
  return NULL;
}
EXPORT void fmi3FreeInstance(fmi3Instance c) { free(c); }

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance c, bool given, double tolerance, double start, bool stops,
                                              double stop) {
  begin(c, start);
  return fmi3OK;
}
EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance c) { return fmi3OK; }
EXPORT fmi3Status fmi3Terminate(fmi3Instance c) { return fmi3OK; }
EXPORT fmi3Status fmi3Reset(fmi3Instance c) {
  reset_values(c);
  return fmi3OK;
}
EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance c) { return NOT_SUPPORTED(c, 1); }
EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance c) { return fmi3OK; }
EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance c) { return NOT_SUPPORTED(c, 1); }
EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance c) { return NOT_SUPPORTED(c, 1); }

EXPORT fmi3Status fmi3GetFloat64(fmi3Instance c, REFERENCES, double values[], size_t m) {
  return n == m ? status(get_values(c, vr, n, values)) : fmi3Error;
}
EXPORT fmi3Status fmi3SetFloat64(fmi3Instance c, REFERENCES, const double values[], size_t m) {
  return n == m ? status(set_values(c, vr, n, values)) : fmi3Error;
}
{% for name, type in types %}
EXPORT fmi3Status fmi3Get{{ name }}(fmi3Instance c, REFERENCES, {{ type }} values[], size_t m) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3Set{{ name }}(fmi3Instance c, REFERENCES, const {{ type }} values[], size_t m) { return NOT_SUPPORTED(c, n); }
{% endfor %}
EXPORT fmi3Status fmi3GetBinary(fmi3Instance c, REFERENCES, size_t sizes[], const uint8_t *values[], size_t m) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3SetBinary(fmi3Instance c, REFERENCES, const size_t sizes[], const uint8_t *const values[],
                                size_t m) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3GetClock(fmi3Instance c, REFERENCES, bool values[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3SetClock(fmi3Instance c, REFERENCES, const bool values[]) { return NOT_SUPPORTED(c, n); }

EXPORT fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *count) {
  return NOT_SUPPORTED(c, 1);
}
EXPORT fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t at[],
                                              fmi3ValueReference independents[], size_t at_independents[], int kinds[],
                                              size_t n) {
  return NOT_SUPPORTED(c, 1);
}

#define DERIVATIVE                                                                                              \
  (fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],   \
   size_t n_knowns, const double seed[], size_t n_seed, double sensitivity[], size_t n_sensitivity) {           \
    return NOT_SUPPORTED(c, 1);                                                                                 \
  }
EXPORT fmi3Status fmi3GetDirectionalDerivative DERIVATIVE
EXPORT fmi3Status fmi3GetAdjointDerivative DERIVATIVE

EXPORT fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, REFERENCES, double intervals[], fmi3IntervalQualifier how[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3GetIntervalFraction(fmi3Instance c, REFERENCES, uint64_t counters[], uint64_t resolutions[],
                                          fmi3IntervalQualifier how[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3GetShiftDecimal(fmi3Instance c, REFERENCES, double shifts[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3GetShiftFraction(fmi3Instance c, REFERENCES, uint64_t counters[], uint64_t resolutions[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3SetIntervalDecimal(fmi3Instance c, REFERENCES, const double intervals[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3SetIntervalFraction(fmi3Instance c, REFERENCES, const uint64_t counters[],
                                          const uint64_t resolutions[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3SetShiftDecimal(fmi3Instance c, REFERENCES, const double shifts[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3SetShiftFraction(fmi3Instance c, REFERENCES, const uint64_t counters[],
                                       const uint64_t resolutions[]) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance c) { return NOT_SUPPORTED(c, 1); }
EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, bool *needed, bool *terminate, bool *nominals, bool *states,
                                           bool *defined, double *time) {
  *needed = *terminate = *nominals = *states = *defined = false;
  *time = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance c) { return NOT_SUPPORTED(c, 1); }
EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, bool final, bool *event, bool *terminate) {
  return NOT_SUPPORTED(c, 1);
}
EXPORT fmi3Status fmi3SetTime(fmi3Instance c, double time) { return NOT_SUPPORTED(c, 1); }
EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance c, const double x[], size_t n) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, double xdot[], size_t n) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance c, double z[], size_t n) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance c, double x[], size_t n) { return NOT_SUPPORTED(c, n); }
EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, double x[], size_t n) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
  *n = 0;
  return fmi3OK;
}
EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
  *n = 0;
  return fmi3OK;
}

EXPORT fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, REFERENCES, const int32_t orders[], double values[],
                                           size_t m) {
  return NOT_SUPPORTED(c, n);
}
EXPORT fmi3Status fmi3DoStep(fmi3Instance c, double time, double length, bool final, bool *event, bool *terminate,
                             bool *early, double *last) {
  const int failed = advance(c, time, length);
  *event = *terminate = *early = false;
  *last = ((model_t *)c)->now.v[0];
  return status(failed);
}
EXPORT fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, double time) {
  return NOT_SUPPORTED(c, 1);
}
