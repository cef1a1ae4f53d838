/* A two-mass rig for model exchange by FMI 2.0, written by hand for the tests: linear springs and dampers.
 *
 * Value references are places in `v`: parameters, states, derivatives, inputs, outputs. It keeps no events.
 * Macros make variants: CRASHES on instantiation; FAILURE, a statement, and FAILED, a status of the
 * getters, at stiffnesses above 600 N/m or another condition WHERE; STRICT refuses parameters in continuous-time mode; SINGLE makes one instance,
 * which cannot be reset and fails at positions above 1 m; TIMED adds the time to the power.
 */
#ifndef WHERE
#define WHERE (v[K1] > 600)
#endif

#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { K1, K2, D1, D2, M1, M2, X1, V1, X2, V2, DX1, DV1, DX2, DV2, FORCE, GUIDE, POS1, POS2, VEL1, POWER, N_V };
typedef struct {
  double v[N_V];
  int continuous; /* in continuous-time mode */
} rig_t;

static double now; /* s; zero unless TIMED */

static void evaluate(double *v) {
#ifdef FAILURE
  if (WHERE) FAILURE;
#endif
  const double inner = v[K2] * (v[X1] - v[X2]) + v[D2] * (v[V1] - v[V2]);
  v[DX1] = v[V1];
  v[DV1] = (v[FORCE] + v[GUIDE] - v[K1] * v[X1] - v[D1] * v[V1] - inner) / v[M1];
  v[DX2] = v[V2];
  v[DV2] = inner / v[M2];
  v[POS1] = v[X1];
  v[POS2] = v[X2];
  v[VEL1] = v[V1];
  v[POWER] = v[FORCE] * v[FORCE] + now;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }
EXPORT int fmi2SetDebugLogging(void *c, int on, size_t n, const char *const categories[]) { return 0; }

EXPORT void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources, const void *functions,
                             int visible, int on) {
  static const double start[N_V] = {380, 1000, 2.3, 1.3, 1.2, 0.8};
  rig_t *m;
#ifdef CRASHES
  abort();
#endif
#ifdef SINGLE
  static int made;
  if (made++) return NULL;
#endif
  if (type != 0 || strcmp(guid, "rig")) return NULL;
  m = malloc(sizeof *m);
  if (m) memcpy(m->v, start, sizeof start);
  if (m) m->continuous = 0;
  return m;
}
EXPORT void fmi2FreeInstance(void *c) { free(c); }
EXPORT int fmi2SetupExperiment(void *c, int given, double tolerance, double start, int stops, double stop) { return 0; }
EXPORT int fmi2EnterInitializationMode(void *c) { return 0; }
EXPORT int fmi2ExitInitializationMode(void *c) { return 0; }
EXPORT int fmi2Terminate(void *c) { return 0; }
EXPORT int fmi2Reset(void *c) {
#ifdef SINGLE
  return 3;
#endif
  ((rig_t *)c)->continuous = 0;
  return 0;
}

EXPORT int fmi2GetReal(void *c, const unsigned vr[], size_t n, double value[]) {
  size_t i;
#ifdef FAILED
  if (((rig_t *)c)->v[K1] > 600) return FAILED;
#endif
  evaluate(((rig_t *)c)->v);
  for (i = 0; i < n; i++) value[i] = ((rig_t *)c)->v[vr[i]];
  return 0;
}
EXPORT int fmi2SetReal(void *c, const unsigned vr[], size_t n, const double value[]) {
  size_t i;
#ifdef STRICT
  for (i = 0; i < n; i++)
    if (vr[i] <= M2 && ((rig_t *)c)->continuous) return 3;
#endif
  for (i = 0; i < n; i++) ((rig_t *)c)->v[vr[i]] = value[i];
  return 0;
}
#define NONE(name, type) \
  EXPORT int name(void *c, const unsigned vr[], size_t n, type value[]) { return n ? 3 : 0; }
NONE(fmi2GetInteger, int)
NONE(fmi2GetBoolean, int)
NONE(fmi2GetString, const char *)
NONE(fmi2SetInteger, const int)
NONE(fmi2SetBoolean, const int)
NONE(fmi2SetString, const char *const)
EXPORT int fmi2GetFMUstate(void *c, void **state) { return 3; }
EXPORT int fmi2SetFMUstate(void *c, void *state) { return 3; }
EXPORT int fmi2FreeFMUstate(void *c, void **state) { return 3; }
EXPORT int fmi2SerializedFMUstateSize(void *c, void *state, size_t *size) { return 3; }
EXPORT int fmi2SerializeFMUstate(void *c, void *state, char bytes[], size_t size) { return 3; }
EXPORT int fmi2DeSerializeFMUstate(void *c, const char bytes[], size_t size, void **state) { return 3; }
EXPORT int fmi2GetDirectionalDerivative(void *c, const unsigned unknown[], size_t n, const unsigned known[], size_t m,
                                        const double seed[], double value[]) {
  return 3;
}

EXPORT int fmi2EnterEventMode(void *c) {
  ((rig_t *)c)->continuous = 0;
  return 0;
}
EXPORT int fmi2NewDiscreteStates(void *c, void *information) {
  memset(information, 0, 5 * sizeof(int));
  return 0;
}
EXPORT int fmi2EnterContinuousTimeMode(void *c) {
  ((rig_t *)c)->continuous = 1;
  return 0;
}
EXPORT int fmi2CompletedIntegratorStep(void *c, int final, int *event, int *terminate) {
  *event = *terminate = 0;
  return 0;
}
EXPORT int fmi2SetTime(void *c, double time) {
#ifdef TIMED
  now = time;
#endif
  return 0;
}
EXPORT int fmi2SetContinuousStates(void *c, const double x[], size_t n) {
  memcpy(((rig_t *)c)->v + X1, x, n * sizeof(double));
  return 0;
}
EXPORT int fmi2GetContinuousStates(void *c, double x[], size_t n) {
  memcpy(x, ((rig_t *)c)->v + X1, n * sizeof(double));
  return 0;
}
EXPORT int fmi2GetDerivatives(void *c, double xdot[], size_t n) {
#ifdef FAILED
  if (((rig_t *)c)->v[K1] > 600) return FAILED;
#endif
#ifdef SINGLE
  if (((rig_t *)c)->v[X1] > 1) return 3;
#endif
  evaluate(((rig_t *)c)->v);
  memcpy(xdot, ((rig_t *)c)->v + DX1, n * sizeof(double));
  return 0;
}
EXPORT int fmi2GetEventIndicators(void *c, double z[], size_t n) { return 0; }
EXPORT int fmi2GetNominalsOfContinuousStates(void *c, double x[], size_t n) {
  size_t i;
  for (i = 0; i < n; i++) x[i] = 1;
  return 0;
}
