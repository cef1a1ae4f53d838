/* Evaluate a functional mock-up unit for model exchange by direct calls: z = (t, x, u, p) -> derivatives, outputs.
 *
 * Tunable parameters change in event mode. A restart changes fixed ones and follows an error; an instance that cannot be
 * reset is replaced by Python.
 */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

enum { OK = 1, DISCARD = 2, MOST_ITERATIONS = 100 }; /* the first two are statuses: a warning, and a refused value */

typedef struct {
  int version; /* 2 or 3 */
  void **instance;
  int *failed;
  long long *calls; /* begun and ended: odd while the unit has not returned */
  int (*restart)(void);  /* with a new instance if this one cannot be reset */
  int (*set_time)(void *, double);
  int (*set_states)(void *, const double *, size_t);
  int (*get_derivatives)(void *, double *, size_t);
  void *set_values, *get_values; /* of reals: FMI 3 takes one argument more */
  int (*enter_events)(void *);
  void *update_states;
  int (*leave_events)(void *);
  int (*reset)(void *);
  int (*set_up)(void *, int, double, double, int, double); /* FMI 2 */
  void *enter_initialisation;
  int (*leave_initialisation)(void *);
  size_t n_x, n_u, n_p, n_y, n_t; /* the first n_t parameters are tunable */
  const unsigned *u_ref, *p_ref, *y_ref;
  double *t, *x, *u, *p, *derivatives, *y, *last_p;
} fmu_t;

typedef struct { /* fmi2EventInfo */
  int update_needed, terminate, nominals_changed, states_changed, next_time_defined;
  double next_time;
} event_t;

typedef int (*set2_t)(void *, const unsigned *, size_t, const double *);
typedef int (*get2_t)(void *, const unsigned *, size_t, double *);
typedef int (*set3_t)(void *, const unsigned *, size_t, const double *, size_t);
typedef int (*get3_t)(void *, const unsigned *, size_t, double *, size_t);
typedef int (*enter2_t)(void *);
typedef int (*enter3_t)(void *, bool, double, double, bool, double);
typedef int (*update2_t)(void *, event_t *);
typedef int (*update3_t)(void *, bool *, bool *, bool *, bool *, bool *, double *);

static int set_values(fmu_t *f, const unsigned *ref, size_t n, const double *values) {
  if (!n) return 0;
  return f->version == 2 ? ((set2_t)f->set_values)(*f->instance, ref, n, values)
                         : ((set3_t)f->set_values)(*f->instance, ref, n, values, n);
}

static int get_values(fmu_t *f, const unsigned *ref, size_t n, double *values) {
  if (!n) return 0;
  return f->version == 2 ? ((get2_t)f->get_values)(*f->instance, ref, n, values)
                         : ((get3_t)f->get_values)(*f->instance, ref, n, values, n);
}

static int update_states(fmu_t *f) {
  int status = 0, i;
  for (i = 0; i < MOST_ITERATIONS; i++) {
    event_t event = {0};
    bool flag[5] = {false};
    double next;
    status = f->version == 2
                 ? ((update2_t)f->update_states)(*f->instance, &event)
                 : ((update3_t)f->update_states)(*f->instance, flag, flag + 1, flag + 2, flag + 3, flag + 4, &next);
    if (status > OK || !(event.update_needed || flag[0])) break;
  }
  return status;
}

static int enter_initialisation(fmu_t *f) {
  int status;
  if (f->version == 3) return ((enter3_t)f->enter_initialisation)(*f->instance, false, 0, 0, false, 0);
  status = f->set_up(*f->instance, 0, 0, 0, 0, 0);
  return status > OK ? status : ((enter2_t)f->enter_initialisation)(*f->instance);
}

static int reset(fmu_t *f) {
  int status;
  if ((status = f->reset(*f->instance)) > OK) return status;
  if ((status = enter_initialisation(f)) > OK) return status;
  if ((status = set_values(f, f->p_ref, f->n_p, f->p)) > OK) return status;
  if ((status = f->leave_initialisation(*f->instance)) > OK) return status;
  if ((status = update_states(f)) > OK) return status;
  return f->leave_events(*f->instance);
}

static int change_parameters(fmu_t *f) {
  const int restarts = *f->failed || (f->n_p > f->n_t && memcmp(f->p + f->n_t, f->last_p + f->n_t,
                                                                (f->n_p - f->n_t) * sizeof(double)));
  int status;
  if (f->n_p) f->last_p[0] = NAN;
  if (restarts) return reset(f) > OK ? f->restart() : 0;
  if ((status = f->enter_events(*f->instance)) > OK) return status;
  if ((status = set_values(f, f->p_ref, f->n_t, f->p)) > OK) return status;
  if ((status = update_states(f)) > OK) return status;
  return f->leave_events(*f->instance);
}

static int is_finite(const double *values, size_t n) {
  size_t i;
  for (i = 0; i < n; i++)
    if (!isfinite(values[i])) return 0;
  return 1;
}

static int evaluate(fmu_t *f) {
  int status;
  if (!isfinite(*f->t) || !is_finite(f->x, f->n_x) || !is_finite(f->u, f->n_u) || !is_finite(f->p, f->n_p))
    return DISCARD; /* a diverged simulation does not call the unit */
  if (*f->failed || (f->n_p && memcmp(f->p, f->last_p, f->n_p * sizeof(double)))) {
    if (change_parameters(f) > OK) return DISCARD + 1; /* the mode is unknown */
    memcpy(f->last_p, f->p, f->n_p * sizeof(double));
  }
  if ((status = f->set_time(*f->instance, *f->t)) > OK) return status;
  if (f->n_x && (status = f->set_states(*f->instance, f->x, f->n_x)) > OK) return status;
  if ((status = set_values(f, f->u_ref, f->n_u, f->u)) > OK) return status;
  if (f->n_x && (status = f->get_derivatives(*f->instance, f->derivatives, f->n_x)) > OK) return status;
  return get_values(f, f->y_ref, f->n_y, f->y);
}

void fmu_evaluate(void *unit) {
  fmu_t *f = unit;
  int status;
  size_t i;
  ++*f->calls;
  status = evaluate(f);
  ++*f->calls;
  if (status != DISCARD) *f->failed = status > DISCARD;
  if (status <= OK) return;
  for (i = 0; i < f->n_x; i++) f->derivatives[i] = NAN;
  for (i = 0; i < f->n_y; i++) f->y[i] = NAN;
}
