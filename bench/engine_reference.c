// SPDX-License-Identifier: Apache-2.0
/* The closed loop of piezo_sim/engine.py in plain C: the yardstick of the engine's speed.
 *
 * Same order of operations, so the samples are the same to rounding. Only what the benchmark runs is
 * here: Prandtl-Ishlinskii plant and inverse without dead zones, nothing to touch.
 *
 *     cc -O3 -shared -fPIC -o engine_reference.so engine_reference.c -lm
 */

#include <math.h>

enum { MAX_PLAYS = 64, MAX_RELAXATIONS = 32, MAX_ORDER = 16, MAX_DELAY = 64 };

typedef struct {
    int plays, relaxations, order, delay;
    double thresholds[MAX_PLAYS], weights[MAX_PLAYS];
    double inverse_thresholds[MAX_PLAYS], inverse_weights[MAX_PLAYS];
    double voltage_limit, step_limit;
    double a[MAX_ORDER * MAX_ORDER], b[MAX_ORDER], c[MAX_ORDER], d;
    double reference_b[MAX_ORDER], reference_d, anti_windup[MAX_ORDER];
    double command_low, command_high;
    double slope, gain_per_degc, lag_per_degc, sensitivity, body_retained;
    double creep_gain, creep_gain_per_degc;
    double creep_retained[MAX_RELAXATIONS], creep_released[MAX_RELAXATIONS];
    double xx, xv, vx, vv, elastic_constant;
    double resolution, noise, dropout_rate;
    double amplifier_limit, amplifier_change, amplifier_retained;
} Coefficients;

typedef struct {
    double plays[MAX_PLAYS], inverse_plays[MAX_PLAYS];
    double x[MAX_ORDER];
    double creep[MAX_RELAXATIONS];
    double line[MAX_DELAY];
    double position, speed, body, start, applied, last_voltage, clipped;
} State;

static double lower(double a, double b) { return b < a ? b : a; }
static double upper(double a, double b) { return b > a ? b : a; }

/* Prandtl-Ishlinskii: one pass moves the plays and sums them up. */
static double plays(const double *thresholds, const double *weights, double *states, int count,
                    double input) {
    double total = weights[0] * input;
    states[0] = input;
    for (int i = 1; i < count; i++) {
        states[i] = lower(input + thresholds[i], upper(input - thresholds[i], states[i]));
        total += weights[i] * states[i];
    }
    return total;
}

static double feedback(const Coefficients *k, State *s, double reference, double deflection) {
    double next[MAX_ORDER];
    double error = reference - deflection;
    double wanted = k->d * error + k->reference_d * reference;
    for (int i = 0; i < k->order; i++) wanted += k->c[i] * s->x[i];
    double command = lower(upper(wanted, k->command_low), k->command_high);
    for (int i = 0; i < k->order; i++) {
        double total = k->b[i] * error + k->reference_b[i] * reference
                       + k->anti_windup[i] * (command - wanted);
        for (int j = 0; j < k->order; j++) total += k->a[i * k->order + j] * s->x[j];
        next[i] = total;
    }
    for (int i = 0; i < k->order; i++) s->x[i] = next[i];
    return command;
}

static double feedforward(const Coefficients *k, State *s, double command) {
    double wanted =
        plays(k->inverse_thresholds, k->inverse_weights, s->inverse_plays, k->plays, command);
    double low = upper(-k->voltage_limit, s->last_voltage - k->step_limit);
    double high = lower(k->voltage_limit, s->last_voltage + k->step_limit);
    double voltage = lower(high, upper(low, wanted));
    if (voltage != wanted) s->clipped += 1.0;
    s->last_voltage = voltage;
    return voltage;
}

static double deflection_of(const Coefficients *k, const State *s) {
    double total = s->position + k->sensitivity * (s->body - s->start);
    for (int i = 0; i < k->relaxations; i++) total += s->creep[i];
    return total;
}

static void read_sensor(const Coefficients *k, State *s, double normal, double uniform) {
    double reading = s->line[k->delay];
    if (uniform >= k->dropout_rate) {
        reading = deflection_of(k, s) + k->noise * normal;
        if (k->resolution > 0.0)
            reading = k->resolution * floor(reading / k->resolution + 0.5);
    }
    for (int i = 0; i < k->delay; i++) s->line[i] = s->line[i + 1];
    s->line[k->delay] = reading;
}

static void advance(const Coefficients *k, State *s, double demand, double temperature,
                    double force) {
    double clipped = lower(k->amplifier_limit, upper(-k->amplifier_limit, demand));
    double followed = lower(s->applied + k->amplifier_change,
                            upper(s->applied - k->amplifier_change, clipped));
    double voltage = followed + k->amplifier_retained * (s->applied - followed);
    s->applied = voltage;

    double warmth = s->body - 22.0;
    double pure = plays(k->thresholds, k->weights, s->plays, k->plays, voltage);
    double lag = k->slope * voltage - pure;
    double fixed = (1.0 + k->gain_per_degc * warmth) * (pure - k->lag_per_degc * warmth * lag);

    double drive = upper(0.0, k->creep_gain + k->creep_gain_per_degc * warmth) * voltage;
    for (int i = 0; i < k->relaxations; i++)
        s->creep[i] = k->creep_retained[i] * s->creep[i] + k->creep_released[i] * drive;
    s->body = temperature + k->body_retained * (s->body - temperature);

    double target = fixed + k->elastic_constant * force;
    double x = s->position - target, v = s->speed;
    s->position = target + (k->xx * x + k->xv * v);
    s->speed = k->vx * x + k->vv * v;
}

void run(const Coefficients *k, State *s, int samples, const double *reference,
         const double *temperature, const double *force, const double *normal,
         const double *uniform, double *deflection, double *command, double *voltage,
         double *tip_force, double *true_deflection) {
    for (int n = 0; n < samples; n++) {
        read_sensor(k, s, normal[n], uniform[n]);
        deflection[n] = s->line[0];
        command[n] = feedback(k, s, reference[n], deflection[n]);
        voltage[n] = feedforward(k, s, command[n]);
        tip_force[n] = n > 0 ? force[n - 1] : 0.0;
        true_deflection[n] = deflection_of(k, s);
        advance(k, s, voltage[n], temperature[n], force[n]);
    }
}
