/* {{ name }}: one step of an identified model, every {{ "%.10g" % dt }} s; {{ "min and max rounded, eps = %g" % smooth if smooth else "min and max exact" }}.
 *
 *   double x[{{ big }}_NX], u[{{ big }}_NU], y[{{ big }}_NY];
 *   {{ name }}_x0(x);                 once, at the start
 *   {{ name }}_step(x, u, x, y);      every sample: y now, and x for the next one
 *
{% if interpolated %}
 * Inputs are interpolated: u holds the inputs of this sample, then those of the next one.
 *
{% endif %}
 * Nothing is allocated and nothing is kept between calls; several threads may call it at once.
 */
#ifndef {{ big }}_H
#define {{ big }}_H

{% for letter, constants in entries.items() %}
#define {{ big }}_N{{ letter }} {{ constants | length }}
{% endfor %}
#define {{ big }}_DT {{ dt }} /* s */
{% for letter, constants in entries.items() %}

/* entries of {{ letter | lower }} */
{% for constant, comment in constants %}
#define {{ constant }} {{ loop.index0 }} /* {{ comment }} */
{% endfor %}
{% endfor %}

#ifdef __cplusplus
extern "C" {
#endif

/* Start state. */
void {{ name }}_x0(double *x);

/* Output at this sample and state at the next one; x_next may be x. */
void {{ name }}_step(const double *x, const double *u, double *x_next, double *y);

#ifdef __cplusplus
}
#endif

#endif
