/* {{ name }}: an identified model as a co-simulation FMU, FMI {{ fmi }}; a sample takes {{ "%.10g" % dt }} s.
 *
 * All variables are doubles in one array, which is also the state that an importer saves: time, parameters, states
 * with the memory of hysteresis, inputs{{ ", slopes of inputs" if interpolated }} and outputs. A value reference is an index of that array.
 * Outputs are evaluated when they are read, from the state and the inputs of that moment.
 */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CASADI_SYMBOL_EXPORT static
{{ code }}
#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define DT {{ dt }} /* s */
#define STEP_TOLERANCE 1e-4 /* of a sample: rounding of communication times */
#define TOKEN "{{ token }}"
enum { N_P = {{ n_p }}, N_X = {{ n_x }}, N_U = {{ n_u }}, N_Y = {{ n_y }} };
enum { AT_P = 1, AT_X = AT_P + N_P, AT_U = AT_X + N_X, AT_SLOPE = AT_U + N_U, AT_Y = AT_SLOPE + {{ "N_U" if interpolated else "0" }}, N_V = AT_Y + N_Y };

static const double start_values[N_V] = {
{% for value in start %}
  {{ value }},
{% endfor %}
};

typedef struct {
  double v[N_V];
  double fresh; /* 1 where the outputs belong to the other values */
} values_t;

typedef void (*report_t)(void *instance, const char *message);

typedef struct {
  values_t now;
  report_t report;
  void *environment;
  void (*logger)(void);
  char name[256];
} model_t;

/* y at these states and inputs, and the states of the next sample unless x_next is a null pointer */
static void evaluate(const double *x, const double *u, const double *p, double *x_next, double *y) {
  const casadi_real *arg[{{ [1, function.sz_arg()] | max }}];
  casadi_real *res[{{ [1, function.sz_res()] | max }}];
  casadi_int iw[{{ [1, function.sz_iw()] | max }}];
  casadi_real w[{{ [1, function.sz_w()] | max }}];
  arg[0] = x;
  arg[1] = u;
  arg[2] = p;
  res[0] = x_next;
  res[1] = y;
  {{ function.name() }}(arg, res, iw, w, 0);
}

/* the inputs at `after` seconds from now{{ ", then those one sample later" if interpolated }} */
static void inputs_at(const double *v, double after, double *u) {
  int i;
  for (i = 0; i < N_U; i++) {
{% if interpolated %}
    u[i] = v[AT_U + i] + v[AT_SLOPE + i] * after;
    u[N_U + i] = v[AT_U + i] + v[AT_SLOPE + i] * (after + DT);
{% else %}
    u[i] = v[AT_U + i];
{% endif %}
  }
  (void)after;
}

static void reset_values(model_t *m) {
  memcpy(m->now.v, start_values, sizeof start_values);
  m->now.fresh = 0;
}

static void begin(model_t *m, double time) {
  m->now.v[0] = time;
{% if time_state is not none %}
  m->now.v[AT_X + {{ time_state }}] = time;
{% endif %}
  m->now.fresh = 0;
}

static model_t *make(const char *name, const char *token, report_t report, void *environment, void (*logger)(void)) {
  model_t *m = calloc(1, sizeof *m);
  if (!m) return NULL;
  m->report = report;
  m->environment = environment;
  m->logger = logger;
  if (name) strncpy(m->name, name, sizeof m->name - 1);
  if (!token || strcmp(token, TOKEN)) {
    report(m, "modelDescription.xml belongs to another binary; export the FMU again.");
    free(m);
    return NULL;
  }
  reset_values(m);
  return m;
}

static int get_values(model_t *m, const uint32_t *vr, size_t n, double *values) {
  size_t i;
  for (i = 0; i < n; i++) {
    if (vr[i] >= N_V) {
      m->report(m, "A value reference is not one of modelDescription.xml.");
      return 1;
    }
    if (vr[i] >= AT_Y && !m->now.fresh) {
      double u[2 * N_U + 1];
      inputs_at(m->now.v, 0, u);
      evaluate(m->now.v + AT_X, u, m->now.v + AT_P, NULL, m->now.v + AT_Y);
      m->now.fresh = 1;
    }
    values[i] = m->now.v[vr[i]];
  }
  return 0;
}

static int set_values(model_t *m, const uint32_t *vr, size_t n, const double *values) {
  size_t i;
  for (i = 0; i < n; i++) {
    if (vr[i] < AT_P || vr[i] >= AT_Y) {
      m->report(m, "Only parameters, inputs and the start values of states can be set.");
      return 1;
    }
    m->now.v[vr[i]] = values[i];
    m->now.fresh = 0;
  }
  return 0;
}

/* Advance by whole samples. */
static int advance(model_t *m, double time, double length) {
  const double count = floor(length / DT + 0.5);
  double *v = m->now.v, u[2 * N_U + 1], y[N_Y + 1], next[N_X + 1];
  long i, k;
  if (!(count >= 1 && count < 1e9 && fabs(length - count * DT) <= STEP_TOLERANCE * DT)) {
    char message[200];
    snprintf(message, sizeof message,
             "The communication step of %.10g s is not a multiple of the sample time %.10g s; use a multiple.", length, DT);
    m->report(m, message);
    return 1;
  }
  for (k = 0; k < (long)count; k++) {
    inputs_at(v, k * DT, u);
    evaluate(v + AT_X, u, v + AT_P, next, y);
    memcpy(v + AT_X, next, N_X * sizeof(double));
  }
  inputs_at(v, length, u);
  memcpy(v + AT_U, u, N_U * sizeof(double));
  v[0] = time + length;
  m->now.fresh = 0;
  for (i = 0; i < N_X; i++)
    if (!isfinite(v[AT_X + i])) {
      m->report(m, "The state is not finite any more; use smaller inputs or other parameters.");
      return 1;
    }
  return 0;
}

static int save_state(model_t *m, void **state) {
  if (!*state) *state = malloc(sizeof(values_t));
  if (!*state) return 1;
  memcpy(*state, &m->now, sizeof(values_t));
  return 0;
}

{% if fmi == "2.0" %}
{% set prefix, state, deserialize, byte = "fmi2", "FMUstate", "DeSerialize", "char" %}
{% include "_fmi2.c" %}
{% else %}
{% set prefix, state, deserialize, byte = "fmi3", "FMUState", "Deserialize", "uint8_t" %}
{% include "_fmi3.c" %}
{% endif %}

EXPORT {{ prefix }}Status {{ prefix }}Get{{ state }}(void *c, void **state) { return status(save_state(c, state)); }
EXPORT {{ prefix }}Status {{ prefix }}Set{{ state }}(void *c, void *state) {
  memcpy(&((model_t *)c)->now, state, sizeof(values_t));
  return {{ prefix }}OK;
}
EXPORT {{ prefix }}Status {{ prefix }}Free{{ state }}(void *c, void **state) {
  free(*state);
  *state = NULL;
  return {{ prefix }}OK;
}
EXPORT {{ prefix }}Status {{ prefix }}Serialized{{ state }}Size(void *c, void *state, size_t *size) {
  *size = sizeof(values_t);
  return {{ prefix }}OK;
}
EXPORT {{ prefix }}Status {{ prefix }}Serialize{{ state }}(void *c, void *state, {{ byte }} bytes[], size_t size) {
  if (size < sizeof(values_t)) return {{ prefix }}Error;
  memcpy(bytes, state, sizeof(values_t));
  return {{ prefix }}OK;
}
EXPORT {{ prefix }}Status {{ prefix }}{{ deserialize }}{{ state }}(void *c, const {{ byte }} bytes[], size_t size, void **state) {
  if (size != sizeof(values_t) || save_state(c, state)) return {{ prefix }}Error;
  memcpy(*state, bytes, size);
  return {{ prefix }}OK;
}
