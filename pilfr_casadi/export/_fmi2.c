/* The functions of FMI 2.0 for co-simulation. */
typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean;
typedef int fmi2Integer;
typedef const char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef void (*fmi2CallbackLogger)(void *, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
typedef struct {
  fmi2CallbackLogger logger;
  void *(*allocateMemory)(size_t, size_t);
  void (*freeMemory)(void *);
  void (*stepFinished)(void *, fmi2Status);
  void *componentEnvironment;
} fmi2CallbackFunctions;

#define NOT_SUPPORTED(c, n) ((n) == 0 ? fmi2OK : (((model_t *)(c))->report(c, "All variables are real."), fmi2Error))
#define REFERENCES const fmi2ValueReference vr[], size_t n

static void report(void *instance, const char *message) {
  model_t *m = instance;
  if (m->logger) ((fmi2CallbackLogger)m->logger)(m->environment, m->name, fmi2Error, "logStatusError", "%s", message);
}

static fmi2Status status(int failed) { return failed ? fmi2Error : fmi2OK; }

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  return fmi2OK;
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean on) {
  if (type != fmi2CoSimulation) return NULL;
  return make(name, guid, report, functions ? functions->componentEnvironment : NULL,
              functions ? (void (*)(void))functions->logger : NULL);
}
EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean given, double tolerance, double start,
                                      fmi2Boolean stops, double stop) {
  begin(c, start);
  return fmi2OK;
}
EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
EXPORT fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }
EXPORT fmi2Status fmi2Reset(fmi2Component c) {
  reset_values(c);
  return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, REFERENCES, double value[]) { return status(get_values(c, vr, n, value)); }
EXPORT fmi2Status fmi2SetReal(fmi2Component c, REFERENCES, const double value[]) {
  return status(set_values(c, vr, n, value));
}
EXPORT fmi2Status fmi2GetInteger(fmi2Component c, REFERENCES, fmi2Integer value[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi2Status fmi2GetBoolean(fmi2Component c, REFERENCES, fmi2Boolean value[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi2Status fmi2GetString(fmi2Component c, REFERENCES, fmi2String value[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi2Status fmi2SetInteger(fmi2Component c, REFERENCES, const fmi2Integer value[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi2Status fmi2SetBoolean(fmi2Component c, REFERENCES, const fmi2Boolean value[]) { return NOT_SUPPORTED(c, n); }
EXPORT fmi2Status fmi2SetString(fmi2Component c, REFERENCES, const fmi2String value[]) { return NOT_SUPPORTED(c, n); }

EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n_unknown,
                                               const fmi2ValueReference known[], size_t n_known, const double seed[],
                                               double sensitivity[]) {
  return fmi2Error;
}

EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, REFERENCES, const fmi2Integer order[],
                                              const double value[]) {
{% if interpolated %}
  size_t i;
  for (i = 0; i < n; i++) {
    if (vr[i] < AT_U || vr[i] >= AT_SLOPE || order[i] != 1) {
      report(c, "Only first derivatives of inputs can be set.");
      return fmi2Error;
    }
    ((model_t *)c)->now.v[vr[i] + N_U] = value[i];
  }
  return fmi2OK;
{% else %}
  return n ? fmi2Error : fmi2OK;
{% endif %}
}
EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, REFERENCES, const fmi2Integer order[], double value[]) {
  return n ? fmi2Error : fmi2OK;
}
EXPORT fmi2Status fmi2DoStep(fmi2Component c, double time, double length, fmi2Boolean final) {
  return status(advance(c, time, length));
}
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2Error; }
EXPORT fmi2Status fmi2GetStatus(fmi2Component c, fmi2StatusKind kind, fmi2Status *value) { return fmi2Discard; }
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, fmi2StatusKind kind, double *value) {
  if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
  *value = ((model_t *)c)->now.v[0];
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, fmi2StatusKind kind, fmi2Integer *value) { return fmi2Discard; }
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, fmi2StatusKind kind, fmi2Boolean *value) {
  if (kind != fmi2Terminated) return fmi2Discard;
  *value = 0;
  return fmi2OK;
}
EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, fmi2StatusKind kind, fmi2String *value) { return fmi2Discard; }
