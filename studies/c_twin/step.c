/* The estimator's step in C: what emb_daemon/estimator and everything it calls compute, once more, over the same records.
 *
 * A yardstick for the compiled step's speed, and a second opinion on its arithmetic: each expression stands as in the Python
 * file that the heading above it names, in the same order, so that without contraction (-ffp-contract=off) the results are
 * equal to the last bit. records.h is written from the numpy dtypes by emb_daemon/bench/twin.py.
 */

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "records.h"

typedef struct parameters Parameters;
typedef struct parameters_thermal Thermal;
typedef struct parameters_effects Effects;
typedef struct state State;
typedef struct state_contact Contact;
typedef struct state_plausibility Plausibility;
typedef struct state_effects EffectStates;
typedef struct sample Sample;
typedef struct estimate Estimate;

#define PI 3.141592653589793

/* As Python's: the first unless the second is beyond it, which matters where one is not a number. */
static inline double min(double a, double b) { return b < a ? b : a; }
static inline double max(double a, double b) { return b > a ? b : a; }
static inline int64_t most(int64_t a, int64_t b) { return b > a ? b : a; }

/* As Python's %: the sign of the divisor. */
static double modulo(double a, double b)
{
    double rest = fmod(a, b);
    return rest != 0.0 && (rest < 0.0) != (b < 0.0) ? rest + b : rest;
}

/* models/stiffness.py */

typedef struct {
    double force, slope;
} Curve;

static inline Curve characteristic_curve(double x, const double *coefficients)
{
    Curve at = {0.0, 0.0};
    if (x <= 0.0)
        return at;
    for (int order = CURVE_TERMS - 1; order >= 0; order--) {
        at.slope = at.slope * x + (order + 1) * coefficients[order];
        at.force = (at.force + coefficients[order]) * x;
    }
    return at;
}

static double mean_slope(double x, double spread, const double *coefficients)
{
    double above = characteristic_curve(x + spread, coefficients).force;
    double below = characteristic_curve(x - spread, coefficients).force;
    return (above - below) / (2.0 * spread);
}

static double travel_at(double force, const double *coefficients)
{
    double low = 0.0, high = 1.0;
    while (characteristic_curve(high, coefficients).force < force) {
        high *= 2.0;
        if (high > 1000.0)
            return INFINITY;
    }
    for (int halving = 0; halving < 50; halving++) {
        double middle = 0.5 * (low + high);
        if (characteristic_curve(middle, coefficients).force < force)
            low = middle;
        else
            high = middle;
    }
    return high;
}

static double first_order_lag(double state, double before, double now, double dt, double time_constant)
{
    if (time_constant <= 0.0)
        return now;
    if (dt <= 0.0)
        return state;
    double ratio = dt / time_constant;
    double decay = exp(-ratio);
    double weight = ratio > 1e-6 ? (1.0 - decay) / ratio : 1.0 - 0.5 * ratio;
    return decay * state + (weight - decay) * before + (1.0 - weight) * now;
}

/* models/torque.py */

static inline double slid_angle(double before, double angle, double flicker)
{
    return min(max(before, angle - flicker), angle + flicker);
}

typedef struct {
    double after, mean, variance;
} Friction;

static Friction friction_state(
    double state, double variance, double travel, double presliding_angle, double dissolving_rate, double dt)
{
    double distance = fabs(travel);
    variance = min(1.0, variance + dissolving_rate * dt);
    if (distance == 0.0)
        return (Friction){state, state, variance};
    double direction = travel > 0.0 ? 1.0 : -1.0;
    double ratio = distance / presliding_angle;
    double decay = exp(-ratio);
    double weight = ratio > 1e-6 ? (1.0 - decay) / ratio : 1.0 - 0.5 * ratio;
    return (Friction){
        direction + (state - direction) * decay, direction + (state - direction) * weight, variance * decay * decay};
}

/* models/thermal.py */

#define STEFAN_BOLTZMANN 5.670374419e-8
#define KELVIN 273.15
#define REFERENCE_C 20.0
#define LONGEST_S 0.25

static double at_depth(const double *temperatures, const double *positions, double depth)
{
    if (depth > positions[NODES - 1] + 1e-9)
        return NAN;
    int node = 0;
    while (node < NODES - 2 && positions[node + 1] < depth)
        node++;
    int first = node - 1 > 0 ? node - 1 : 0;
    if (first > NODES - 4)
        first = NODES - 4;
    double total = 0.0;
    for (int i = first; i < first + 4; i++) {
        double weight = 1.0;
        for (int j = first; j < first + 4; j++)
            if (j != i)
                weight *= (depth - positions[j]) / (positions[i] - positions[j]);
        total += weight * temperatures[i];
    }
    return total;
}

static double mean_temperature(const double *temperatures, const double *positions)
{
    double total = 0.0;
    for (int node = 0; node < NODES - 1; node++)
        total += 0.5 * (temperatures[node] + temperatures[node + 1]) * (positions[node + 1] - positions[node]);
    return total / positions[NODES - 1];
}

static inline double conductance(const Thermal *p, double below, double above, double distance)
{
    return p->conductivity * (1.0 + p->conductivity_rise * (0.5 * (below + above) - REFERENCE_C)) / distance;
}

static double disc_loss(const Thermal *p, double disc, double ambient, double wheel_speed)
{
    double hot = disc + KELVIN, cold = ambient + KELVIN;
    double radiation = p->disc_radiating_area * STEFAN_BOLTZMANN * (hot + cold) * (hot * hot + cold * cold);
    return p->disc_cooling + p->disc_cooling_per_speed * wheel_speed + radiation;
}

static double chain_step(
    const Thermal *p, double pads[2][NODES], double disc, double inner_backplate, double outer_backplate, double ambient,
    double power, bool braking, double wheel_speed, double dt, double work[4][CHAIN])
{
    double *lower = work[0], *diagonal = work[1], *upper = work[2], *right = work[3];
    const double *positions = p->node_position;
    double contact = braking ? p->contact_conductance : p->gap_conductance;
    double to_air = braking ? 0.0 : p->surface_cooling_per_speed * wheel_speed;
    const double *heat_share = p->heat_share;
    for (int side = 0; side < 2; side++) {
        const double *pad = pads[side];
        double backplate = side == 0 ? inner_backplate : outer_backplate;
        for (int node = 0; node < NODES; node++) {
            double below = node > 0 ? positions[node] - positions[node - 1] : 0.0;
            double above = node < NODES - 1 ? positions[node + 1] - positions[node] : 0.0;
            double capacity = p->density * p->specific_heat * (1.0 + p->specific_heat_rise * (pad[node] - REFERENCE_C)) * 0.5
                * (below + above) / dt;
            double diag = capacity, rhs = capacity * pad[node], to_disc, to_plate = 0.0;
            if (node > 0) {
                to_disc = conductance(p, pad[node - 1], pad[node], below);
            } else {
                to_disc = contact;
                diag += to_air;
                rhs += heat_share[side] * power / p->area + to_air * ambient;
            }
            diag += to_disc;
            if (node < NODES - 1) {
                to_plate = conductance(p, pad[node], pad[node + 1], above);
                diag += to_plate;
            } else {
                diag += p->backplate_conductance;
                rhs += p->backplate_conductance * backplate;
            }
            int row = side == 0 ? NODES - 1 - node : NODES + 1 + node;
            diagonal[row] = diag;
            right[row] = rhs;
            lower[row] = side == 0 ? -to_plate : -to_disc;
            upper[row] = side == 0 ? -to_disc : -to_plate;
        }
    }
    double loss = disc_loss(p, disc, ambient, wheel_speed) / p->area;
    double storage = p->disc_heat_capacity / (p->area * dt);
    diagonal[NODES] = storage + 2.0 * contact + loss;
    right[NODES] = storage * disc + loss * ambient + (1.0 - heat_share[0] - heat_share[1]) * power / p->area;
    lower[NODES] = upper[NODES] = -contact;

    for (int row = 1; row < CHAIN; row++) {
        double factor = lower[row] / diagonal[row - 1];
        diagonal[row] -= factor * upper[row - 1];
        right[row] -= factor * right[row - 1];
    }
    right[CHAIN - 1] /= diagonal[CHAIN - 1];
    for (int row = CHAIN - 2; row >= 0; row--)
        right[row] = (right[row] - upper[row] * right[row + 1]) / diagonal[row];
    for (int node = 0; node < NODES; node++) {
        pads[0][node] = right[NODES - 1 - node];
        pads[1][node] = right[NODES + 1 + node];
    }
    return right[NODES];
}

static double heat_step(
    const Thermal *p, double pads[2][NODES], double disc, double inner_backplate, double outer_backplate, double ambient,
    double power, bool braking, double wheel_speed, double dt, double work[4][CHAIN])
{
    int64_t parts = (int64_t)ceil(dt / LONGEST_S - 1e-9);
    for (int64_t part = 0; part < parts; part++)
        disc = chain_step(
            p, pads, disc, inner_backplate, outer_backplate, ambient, power, braking, wheel_speed, dt / (double)parts, work);
    return disc;
}

static int cell(const double *grid, int count, double value, double *share)
{
    int last = count - 1, index = 0;
    if (value <= grid[0]) {
        *share = 0.0;
        return 0;
    }
    if (value >= grid[last]) {
        *share = 1.0;
        return last - 1;
    }
    while (grid[index + 1] < value)
        index++;
    *share = (value - grid[index]) / (grid[index + 1] - grid[index]);
    return index;
}

static double friction_power(const Thermal *p, double force, double wheel_speed, double surface)
{
    if (force <= 0.0 || wheel_speed <= 0.0)
        return 0.0;
    double u, v, w;
    int i = cell(p->friction_force, FORCE_GRID, force, &u);
    int j = cell(p->friction_speed, SPEED_GRID, wheel_speed, &v);
    int k = cell(p->friction_temperature, TEMPERATURE_GRID, surface, &w);
    double friction = 0.0;
    for (int a = 0; a < 2; a++)
        for (int b = 0; b < 2; b++)
            for (int c = 0; c < 2; c++) {
                double share = (a ? u : 1.0 - u) * (b ? v : 1.0 - v) * (c ? w : 1.0 - w);
                friction += share * p->friction_coefficient[i + a][j + b][k + c];
            }
    return 2.0 * friction * p->effective_radius * force * wheel_speed;
}

static inline double stiffness_factor(const Thermal *p, double rise, double history)
{
    return max(1.0 - p->softening * rise - p->softening_history * history, 0.1);
}

/* models/contact.py */

enum { NOTHING, TOO_LATE, TOO_EARLY };
#define DRIFT 0.45
#define LOG_RUN 17.0
#define TURNED_OVER 0.9
#define LEAST 100.0
#define MOST 500.0
#define SMOOTHED 15.0
#define CONFIRMING 100
#define TOLERANCE 0.07
#define TELLING 3.0
#define SHOWN 20.0
#define CORRELATED 1.5
#define CERTAIN 4.0

static double threshold(double current_share, double correlation_time, double dt)
{
    double rho = exp(-dt / correlation_time);
    double inflation = current_share * (1.0 + rho) / (1.0 - rho) + 1.0 - current_share;
    return 0.5 * inflation * (LOG_RUN + log(2.0 * DRIFT * DRIFT)) / DRIFT;
}

static void engaged(Contact *c, double x, double contact_sigma)
{
    if (x > CERTAIN * contact_sigma)
        c->engaged = true;
    else if (x < -CERTAIN * contact_sigma || (x < 0.0 && c->rise == 0.0))
        c->engaged = false;
}

static double clearance_level(const Contact *c, double sigma, double offset, double *offset_sigma)
{
    if (c->samples < SHOWN)
        return offset;
    *offset_sigma = CORRELATED * sigma / sqrt(c->samples);
    return c->level;
}

static int watch_closing(
    Contact *c, double torque, double predicted, double friction_mean, double sigma, double limit, double x,
    double contact_sigma, double offset, double offset_sigma)
{
    if (!isfinite(torque))
        return NOTHING;
    c->watched = min(c->watched + 1.0, SMOOTHED);
    double level_sigma = offset_sigma;
    double level = clearance_level(c, sigma, offset, &level_sigma);
    c->excess += (torque - predicted - level - c->excess) / c->watched;
    if (friction_mean < TURNED_OVER)
        return NOTHING;
    bool clear = x < -CERTAIN * contact_sigma;
    if (clear) {
        c->samples = min(c->samples + 1.0, MOST);
        c->level += (torque - c->level) / c->samples;
    }
    double above = torque - predicted - level, tolerated = TOLERANCE * predicted + level_sigma;
    if (c->samples >= LEAST || !clear)
        c->rise = max(0.0, c->rise + (above - tolerated) / sigma - DRIFT);
    c->shortfall = max(0.0, c->shortfall - (above + tolerated) / sigma - DRIFT);
    if (c->rise > limit) {
        bool was_engaged = c->engaged;
        c->rise = 0.0;
        c->agreed = 0;
        c->engaged = true;
        if (clear || (was_engaged && !c->confirmed))
            return TOO_LATE;
    }
    if (c->shortfall > limit) {
        c->shortfall = 0.0;
        c->agreed = 0;
        if (x > 0.0 && !c->confirmed) {
            c->engaged = false;
            return TOO_EARLY;
        }
    }
    if (x > 0.0 && predicted > TELLING * sigma && max(c->rise, c->shortfall) < 0.5 * limit) {
        c->agreed += 1;
        c->confirmed = c->confirmed || c->agreed >= CONFIRMING;
    }
    return NOTHING;
}

static void start_anew(Contact *c, double variance)
{
    c->lost = true;
    c->confirmed = false;
    c->agreed = 0;
    c->rise = c->shortfall = c->excess = c->watched = 0.0;
    c->prior = variance;
}

static double torque_bias(const Contact *c, double variance, double misread)
{
    if (!(c->prior > 0.0))
        return 0.0;
    double share = max(0.0, 1.0 - variance / c->prior);
    return share * misread * sqrt(c->prior / (c->prior + misread * misread));
}

static double clearly_above(const Contact *c, double sigma)
{
    return c->watched > 0.0 ? 5.0 * sigma / sqrt(c->watched) : INFINITY;
}

/* models/fusion.py */

static double maximum_likelihood(double stiffness, double stiffness_sigma, double torque, double torque_sigma)
{
    double vs = stiffness_sigma * stiffness_sigma, vt = torque_sigma * torque_sigma;
    return stiffness + vs / (vs + vt) * (torque - stiffness);
}

static void predict_errors(
    double *x, double P[STATES][STATES], double decay, double contact_variance, double gain_variance, double noise_decay,
    double noise_variance, double offset_variance)
{
    const int coloured[2] = {0, 3};
    const double factors[2] = {decay, noise_decay};
    for (int which = 0; which < 2; which++) {
        int i = coloured[which];
        double factor = factors[which];
        x[i] *= factor;
        for (int j = 0; j < STATES; j++) {
            P[i][j] *= factor;
            P[j][i] *= factor;
        }
    }
    P[0][0] += 1.0 - decay * decay;
    P[1][1] += contact_variance;
    P[2][2] += gain_variance;
    P[3][3] += (1.0 - noise_decay * noise_decay) * noise_variance;
    P[4][4] += offset_variance;
}

static double update_errors(
    double *x, double P[STATES][STATES], double *gain, double innovation, const double *h, double variance)
{
    double s = variance;
    for (int i = 0; i < STATES; i++) {
        gain[i] = 0.0;
        for (int j = 0; j < STATES; j++)
            gain[i] += P[i][j] * h[j];
        s += h[i] * gain[i];
    }
    for (int i = 0; i < STATES; i++)
        x[i] += gain[i] / s * innovation;
    for (int i = 0; i < STATES; i++)
        for (int j = 0; j <= i; j++) {
            P[i][j] -= gain[i] * gain[j] / s;
            P[j][i] = P[i][j];
        }
    return s;
}

static double variance_along(double P[STATES][STATES], const double *h)
{
    double total = 0.0;
    for (int i = 0; i < STATES; i++)
        for (int j = 0; j < STATES; j++)
            total += h[i] * P[i][j] * h[j];
    return total;
}

/* models/plausibility.py */

enum { AGREE, TORQUE_WRONG, TORQUE_FROZEN, STIFFNESS_WRONG, UNDECIDED };
#define TOLERATED 20.0
#define COUNTED 144.0
#define RAISE 600.0
#define CLEAR 150.0
#define UNCONFIRMED 5.0
#define REPEATED 8
#define NEVER_REPEATED 50
#define COMPARED_S 0.1
#define UNLIKE_RAD 0.6
#define DELAY_S 0.01
#define RETURNED 25
#define ALIKE_RAD 0.05
#define STICTION 0.3
#define CLEAR_OF_CONTACT 6.0
#define AVERAGED_S 0.04

static void watch(
    Plausibility *c, const Sample *m, double angle_before, double speed_before, double past_contact, double contact_sigma,
    bool confirmed)
{
    double travel = m->angle - angle_before;
    double step = travel - 0.5 * (m->speed + speed_before) * m->dt;
    double delay = DELAY_S * fabs(m->speed);
    c->unlike = c->unlike * exp(-m->dt / COMPARED_S) + step;
    if (fabs(step) > ALIKE_RAD + delay)
        c->alike = 0;
    else if (travel != 0.0)
        c->alike += 1;
    c->still = travel == 0.0 && m->speed == speed_before ? c->still + 1 : 0;
    if (m->has_current) {
        c->idle = m->current_q == c->current ? c->idle + 1 : 0;
        c->current = m->current_q;
    }
    int64_t was = c->verdict;
    if (was == STIFFNESS_WRONG) {
        c->frozen_s += m->dt;
        if (c->alike >= RETURNED) {
            c->doubt = c->unlike = c->frozen_s = 0.0;
            c->verdict = AGREE;
        }
        return;
    }
    double patience = confirmed || most(c->still, c->idle) >= REPEATED ? 1.0 : UNCONFIRMED;
    bool disagree = c->doubt > (was == AGREE ? patience * RAISE : CLEAR);
    bool repeated = c->still >= NEVER_REPEATED && m->speed != 0.0;
    if (repeated || fabs(c->unlike) > UNLIKE_RAD + delay || (disagree && c->still >= REPEATED && c->idle < REPEATED)) {
        c->verdict = STIFFNESS_WRONG;
        c->frozen_s = (double)c->still * m->dt;
        c->alike = 0;
    } else if (!disagree) {
        c->verdict = AGREE;
    } else if (c->idle >= REPEATED && c->still < REPEATED) {
        c->verdict = TORQUE_FROZEN;
    } else if (was == TORQUE_WRONG || was == TORQUE_FROZEN || past_contact < -CLEAR_OF_CONTACT * contact_sigma) {
        c->verdict = TORQUE_WRONG;
    } else {
        c->verdict = UNDECIDED;
    }
}

static bool frozen(const Plausibility *c)
{
    return c->verdict == STIFFNESS_WRONG || c->verdict == TORQUE_FROZEN || (c->still > 0) != (c->idle > 0)
        || (c->still < REPEATED && REPEATED <= c->idle);
}

static double beyond_friction(
    double torque, double force, double sigma, double gear_gain, double load_friction, double offset_friction)
{
    double band = (1.0 + STICTION) * (offset_friction + load_friction * force);
    return max(fabs(torque - gear_gain * force) - band, 0.0) / sigma;
}

static void count_doubt(Plausibility *c, double ratio)
{
    if (isfinite(ratio))
        c->doubt = min(max(c->doubt + min(ratio * ratio, COUNTED) - TOLERATED, 0.0), 1.5 * UNCONFIRMED * RAISE);
}

static double force_of_torque_alone(
    Plausibility *c, double torque, bool has_current, double dt, double gear_gain, double load_friction,
    double offset_friction, double *sigma)
{
    if (has_current) {
        double share = 1.0 - exp(-dt / AVERAGED_S);
        double off = torque - c->torque_mean;
        c->torque_mean += share * off;
        c->torque_variance = (1.0 - share) * (c->torque_variance + share * off * off);
    }
    double force = max(c->torque_mean / gear_gain, 0.0);
    double friction = offset_friction + load_friction * force;
    *sigma = sqrt(friction * friction + c->torque_variance) / gear_gain;
    return force;
}

/* effects/disc_thickness_variation.py */

#define PULSES_PER_TURN 96
#define PULSE_MODULO 4096
#define CORRECTION 0.2

static double track(struct state_effects_disc_thickness_variation *s, double pulse, double wheel_speed, double dt)
{
    double width = 2.0 * PI / PULSES_PER_TURN;
    if (!s->known) {
        s->known = true;
        s->count = pulse;
        s->turned = (pulse + 0.5) * width;
        return s->turned;
    }
    s->turned += wheel_speed * dt;
    double moved
        = modulo(pulse - modulo(s->count, PULSE_MODULO) + PULSE_MODULO / 2, PULSE_MODULO) - PULSE_MODULO / 2;
    if (moved != 0.0) {
        s->count += moved;
        double error = (s->count + 0.5) * width - s->turned;
        s->turned += fabs(error) > 2.0 * width + 0.02 * wheel_speed ? error : CORRECTION * error;
    }
    return s->turned;
}

static double disc_thickness_variation(
    const struct parameters_effects_disc_thickness_variation *p, struct state_effects_disc_thickness_variation *s,
    double pulse, bool has_pulse, double wheel_speed, double dt)
{
    if (p->order_1_cosine_um == 0.0 && p->order_1_sine_um == 0.0 && p->order_2_cosine_um == 0.0 && p->order_2_sine_um == 0.0
        && p->order_3_cosine_um == 0.0 && p->order_3_sine_um == 0.0 && p->order_4_cosine_um == 0.0
        && p->order_4_sine_um == 0.0)
        return 0.0;
    if (!has_pulse) {
        s->known = false;
        return 0.0;
    }
    double angle = track(s, pulse, wheel_speed, dt);
    return 1e-6
        * (p->order_1_cosine_um * cos(angle) + p->order_1_sine_um * sin(angle) + p->order_2_cosine_um * cos(2.0 * angle)
            + p->order_2_sine_um * sin(2.0 * angle) + p->order_3_cosine_um * cos(3.0 * angle)
            + p->order_3_sine_um * sin(3.0 * angle) + p->order_4_cosine_um * cos(4.0 * angle)
            + p->order_4_sine_um * sin(4.0 * angle));
}

/* effects/disc_thermal_expansion.py, pad_wear.py, backlash.py, stiffness_hysteresis.py, second_relaxation.py */

static double disc_thermal_expansion(
    const struct parameters_effects_disc_thermal_expansion *p, struct state_effects_disc_thermal_expansion *s, double disc,
    bool known)
{
    if (p->growth_um_per_K == 0.0 || !known)
        return 0.0;
    if (!s->known) {
        s->known = true;
        s->start_C = disc;
    }
    return 1e-6 * p->growth_um_per_K * (disc - s->start_C);
}

static double pad_wear(
    const struct parameters_effects_pad_wear *p, struct state_effects_pad_wear *s, double power, double dt)
{
    if (p->wear_um_per_MJ == 0.0)
        return 0.0;
    s->energy_MJ += 1e-6 * power * dt;
    return 1e-6 * p->wear_um_per_MJ * s->energy_MJ;
}

static double backlash(const struct parameters_effects_backlash *p, struct state_effects_backlash *s, double angle)
{
    if (p->play_rad == 0.0)
        return 0.0;
    double half = 0.5 * fabs(p->play_rad);
    if (!s->known) {
        s->known = true;
        s->follower = angle - half;
    }
    s->follower = min(max(s->follower, angle - half), angle + half);
    return (s->follower - angle + half) * (p->play_rad > 0.0 ? 1.0 : -1.0);
}

static double stiffness_hysteresis(
    const struct parameters_effects_stiffness_hysteresis *p, struct state_effects_stiffness_hysteresis *s, double travel)
{
    if (p->share == 0.0)
        return 0.0;
    s->slip = min(max(s->slip + travel / p->slip_angle_rad, -1.0), 1.0);
    return p->share * s->slip;
}

static double second_relaxation(
    const struct parameters_effects_second_relaxation *p, struct state_effects_second_relaxation *s, double static_force,
    double dt)
{
    if (p->share == 0.0)
        return 0.0;
    s->force = first_order_lag(s->force, s->before, static_force, dt, p->time_constant_s);
    s->before = static_force;
    return p->share * (s->force - static_force);
}

/* effects/torque_constant_fade.py, gear_mesh_ripple.py, cogging_torque.py, stribeck_friction.py */

static double torque_constant_fade(
    const struct parameters_effects_torque_constant_fade *p, double caliper, bool has_caliper, double disc, bool has_disc)
{
    if (p->fade_per_K == 0.0 || !has_caliper)
        return 0.0;
    double temperature = caliper + (has_disc ? p->disc_share * (disc - caliper) : 0.0);
    return -p->fade_per_K * (temperature - 25.0);
}

static double cycle_mean(double cosine, double sine, double order, double angle, double travel)
{
    double phase = order * (angle - 0.5 * travel);
    double half = 0.5 * order * travel;
    double mean = fabs(half) > 1e-4 ? sin(half) / half : 1.0 - half * half / 6.0;
    return mean * (cosine * cos(phase) + sine * sin(phase));
}

static double gear_mesh_ripple(const struct parameters_effects_gear_mesh_ripple *p, double angle, double travel)
{
    if (p->cosine == 0.0 && p->sine == 0.0)
        return 0.0;
    return cycle_mean(p->cosine, p->sine, p->order_per_turn, angle, travel);
}

static double cogging_torque(const struct parameters_effects_cogging_torque *p, double angle, double travel)
{
    if (p->cosine_Nm == 0.0 && p->sine_Nm == 0.0)
        return 0.0;
    return cycle_mean(p->cosine_Nm, p->sine_Nm, p->order_per_turn, angle, travel);
}

static double stribeck_friction(const struct parameters_effects_stribeck_friction *p, double mean_speed)
{
    if (p->rise == 0.0)
        return 0.0;
    return p->rise * exp(-fabs(mean_speed) / p->speed_rad_per_s);
}

/* effects/friction_coefficient_fade.py, disc_radiation.py, thermocouple_lag.py */

static double friction_coefficient_fade(const struct parameters_effects_friction_coefficient_fade *p, double surface)
{
    if (p->fade_per_K == 0.0)
        return 0.0;
    return -min(p->fade_per_K * max(surface - p->onset_C, 0.0), 0.8);
}

static double disc_radiation(
    const struct parameters_effects_disc_radiation *p, double heat_capacity, double disc, double ambient, double dt)
{
    if (p->area_m2 == 0.0)
        return 0.0;
    double hot = disc + KELVIN, cold = ambient + KELVIN;
    return -p->area_m2 * STEFAN_BOLTZMANN * (hot * hot * hot * hot - cold * cold * cold * cold) * dt / heat_capacity;
}

static double thermocouple_lag(
    const struct parameters_effects_thermocouple_lag *p, struct state_effects_thermocouple_lag *s, int side, double value,
    double dt)
{
    if (p->lag_s == 0.0)
        return 0.0;
    if (s->known[side] == 0) {
        s->known[side] = 1;
        s->smoothed[side] = value;
    }
    s->smoothed[side] += (1.0 - exp(-dt / 2.0)) * (value - s->smoothed[side]);
    return p->lag_s / 2.0 * (value - s->smoothed[side]);
}

/* effects/paths.py */

static double gained_thickness(
    const Effects *e, EffectStates *s, const Sample *m, double disc, bool disc_known, double power)
{
    double wheel_speed = m->has_wheel_speed ? m->wheel_speed : 0.0;
    return disc_thickness_variation(
               &e->disc_thickness_variation, &s->disc_thickness_variation, m->wheel_pulse, m->has_wheel_pulse, wheel_speed,
               m->dt)
        + disc_thermal_expansion(&e->disc_thermal_expansion, &s->disc_thermal_expansion, disc, disc_known)
        - pad_wear(&e->pad_wear, &s->pad_wear, power, m->dt);
}

static double spindle_ahead(const Effects *e, EffectStates *s, const Sample *m)
{
    return e->signal_delay.delay_s * m->speed + backlash(&e->backlash, &s->backlash, m->angle);
}

static double static_force(const Effects *e, EffectStates *s, double force, double travel, double dt)
{
    double drive = force * (1.0 + stiffness_hysteresis(&e->stiffness_hysteresis, &s->stiffness_hysteresis, travel));
    return drive + second_relaxation(&e->second_relaxation, &s->second_relaxation, drive, dt);
}

static double motor_torque(
    const Effects *e, const Sample *m, double torque_constant, double travel, double mean_speed, double disc,
    bool disc_known)
{
    double fade = torque_constant_fade(&e->torque_constant_fade, m->caliper, m->has_thermocouple, disc, disc_known);
    double torque = torque_constant * (1.0 + fade) * (m->current_q + e->current_offset.offset_A);
    return torque - e->viscous_friction.viscous_Nms_per_rad * mean_speed
        - cogging_torque(&e->cogging_torque, m->angle, travel);
}

static double gear(const Effects *e, double angle, double travel, double mean_speed, double friction_mean, double *friction)
{
    *friction = 1.0 + stribeck_friction(&e->stribeck_friction, mean_speed);
    *friction += e->friction_asymmetry.asymmetry * friction_mean;
    return 1.0 + gear_mesh_ripple(&e->gear_mesh_ripple, angle, travel);
}

/* estimator/step.py */

#define CYCLE_S 0.004
#define ONE_CYCLE_S (1.5 * CYCLE_S)
#define SILENCE_S 0.1
#define TOUCHING_N 200.0
#define TURNING_RAD_PER_S 0.5
#define DOUBTED_K 10.0
#define HEAT_STEP_S 0.046
#define DISSOLVING_PER_S 0.05
#define SELF_LOCKING 0.2
#define FLICKER_RAD 0.0008
#define SPEED_MARGIN 1.2
#define ANGLE_MARGIN 0.5
#define DOUBTFUL_RAD 0.05
#define KNOWN_RAD 0.3
#define UNCERTAIN_RAD 0.5
#define UNKNOWN_RAD 1.0
#define CLAMPED 0.1
#define LONG_S 1e6
#define TORQUE_GAIN_WALK 1e-9
#define OFFSET 4
#define OFFSET_SHARE 0.1
#define OFFSET_DRIFTS_S 36000.0
#define GATE 5.0
#define JUMP_K 10.0
#define SHOWN_K 20.0
static const double depths_m[] = {0.002, 0.004, 0.006, 0.008};
enum { DEPTHS = sizeof depths_m / sizeof *depths_m };

static inline double square(double value) { return value * value; }

static double torque_offset(const Parameters *p) { return OFFSET_SHARE * p->gear_gain * p->maximum_force; }

static void start(State *s, const Parameters *p, const Sample *m)
{
    s->started = true;
    s->angle = s->slid_angle = m->angle;
    s->speed = m->speed;
    s->contact_angle = m->angle + p->clearance;
    s->past_contact = -p->clearance;
    s->friction_variance = 1.0;
    s->torque_age = 1e9;
    memset(s->covariance, 0, sizeof s->covariance);
    s->covariance[0][0] = 1.0;
    s->covariance[1][1] = s->contact.prior = p->clearance_sigma * p->clearance_sigma;
    s->covariance[2][2] = p->torque_relative_sigma * p->torque_relative_sigma;
    s->covariance[3][3] = square(p->torque_constant * p->current_sigma);
    s->covariance[OFFSET][OFFSET] = square(torque_offset(p));
    s->balance = NAN;
}

static bool follow_zero(State *s, const Parameters *p, const Sample *m)
{
    double jump = m->angle - s->angle;
    double reach = p->maximum_speed * (m->dt + s->plausibility.frozen_s);
    if (fabs(jump) <= SPEED_MARGIN * reach + ANGLE_MARGIN)
        return false;
    s->angle += jump;
    s->slid_angle += jump;
    s->contact_angle += jump;
    s->covariance[1][1] += reach * reach;
    s->contact.prior += reach * reach;
    s->contact.confirmed = false;
    return true;
}

static void tell_temperatures(State *s, const Thermal *t)
{
    for (int side = 0; side < 2; side++) {
        s->mean[side] = mean_temperature(s->pads[side], t->node_position);
        for (int index = 0; index < DEPTHS; index++)
            s->depth[side][index] = at_depth(s->pads[side], t->node_position, depths_m[index]);
    }
}

static void start_heat(State *s, const Thermal *t, const Sample *m)
{
    s->disc = 0.5 * (m->inner_backplate + m->outer_backplate);
    for (int node = 0; node < NODES; node++) {
        double share = t->node_position[node] / t->thickness;
        s->pads[0][node] = s->disc + share * (m->inner_backplate - s->disc);
        s->pads[1][node] = s->disc + share * (m->outer_backplate - s->disc);
    }
    s->ambient = s->disc;
    s->temperature_doubt = s->history_doubt = fabs(s->disc - m->caliper);
    tell_temperatures(s, t);
    s->plate[0] = m->inner_backplate;
    s->plate[1] = m->outer_backplate;
    for (int side = 0; side < 2; side++)
        s->plate_mean[side] = s->mean[side];
    s->history = 0.5 * (s->mean[0] + s->mean[1]) - t->reference;
    s->factor = stiffness_factor(t, s->history, s->history);
    s->temperature_known = true;
}

static void watch_plates(State *s, const Thermal *t, const Sample *m, double dt)
{
    double conducting = 0.25 * t->thickness * t->thickness * t->density * t->specific_heat / t->conductivity;
    bool stuck = false;
    for (int side = 0; side < 2; side++) {
        double reading = m->has_thermocouple ? side == 0 ? m->inner_backplate : m->outer_backplate : NAN;
        double jump = fabs(reading - s->plate[side]);
        if (jump == 0.0) {
            s->unanswered[side] += dt * (s->mean[side] - s->plate_mean[side]);
        } else {
            s->unanswered[side] = 0.0;
            s->plate_mean[side] = s->mean[side];
        }
        if (jump > JUMP_K)
            s->temperature_doubt = max(s->temperature_doubt, jump);
        stuck = stuck || fabs(s->unanswered[side]) > SHOWN_K * conducting;
        s->plate[side] = reading;
    }
    s->plate_stuck = stuck;
    if (stuck)
        s->temperature_doubt = max(s->temperature_doubt, SHOWN_K);
}

static void flow(State *s, const Thermal *t, const Effects *e, const Sample *m)
{
    double dt = s->heat_time;
    double wheel_speed = s->heat_travel / dt;
    if (m->has_status)
        s->ambient = m->ambient;
    double ambient = s->ambient;
    double inner = m->has_thermocouple ? m->inner_backplate : s->pads[0][NODES - 1];
    double outer = m->has_thermocouple ? m->outer_backplate : s->pads[1][NODES - 1];
    watch_plates(s, t, m, dt);
    inner += thermocouple_lag(&e->thermocouple_lag, &s->effects.thermocouple_lag, 0, inner, dt);
    outer += thermocouple_lag(&e->thermocouple_lag, &s->effects.thermocouple_lag, 1, outer, dt);
    s->disc = heat_step(
        t, s->pads, s->disc, inner, outer, ambient, s->heat_energy / dt, s->touching, wheel_speed, dt, s->work);
    s->disc += disc_radiation(&e->disc_radiation, t->disc_heat_capacity, s->disc, ambient, dt);
    tell_temperatures(s, t);
    double rise = 0.5 * (s->mean[0] + s->mean[1]) - t->reference;
    double forgotten = exp(-dt / t->history_time);
    s->history = forgotten * s->history + (1.0 - forgotten) * rise;
    s->factor = stiffness_factor(t, rise, s->history);
    s->temperature_doubt *= exp(-dt * disc_loss(t, s->disc, ambient, wheel_speed) / t->disc_heat_capacity);
    s->history_doubt *= forgotten;
    s->heat_time = s->heat_energy = s->heat_travel = 0.0;
}

static void heat(State *s, const Parameters *p, const Sample *m)
{
    const Thermal *t = &p->thermal;
    if (!s->temperature_known) {
        s->factor = 1.0;
        if (m->has_thermocouple)
            start_heat(s, t, m);
        return;
    }
    bool touching = s->fused > TOUCHING_N;
    if (touching != s->touching && s->heat_time > 0.0)
        flow(s, t, &p->effects, m);
    s->touching = touching;
    double wheel_speed = m->has_wheel_speed ? m->wheel_speed : 0.0;
    s->heat_time += m->dt;
    s->heat_travel += wheel_speed * m->dt;
    s->power = 0.0;
    if (touching && wheel_speed > TURNING_RAD_PER_S) {
        if (isnan(m->brake_torque)) {
            double surface = 0.5 * (s->pads[0][0] + s->pads[1][0]);
            s->power = friction_power(t, s->fused, wheel_speed, surface)
                * (1.0 + friction_coefficient_fade(&p->effects.friction_coefficient_fade, surface));
        } else {
            s->power = max(m->brake_torque, 0.0) * wheel_speed;
        }
        s->heat_energy += s->power * m->dt;
    }
    if (s->heat_time >= HEAT_STEP_S)
        flow(s, t, &p->effects, m);
}

static double position(State *s, const Parameters *p, const Sample *m)
{
    double gained = gained_thickness(&p->effects, &s->effects, m, s->disc, s->temperature_known, s->power);
    return m->angle + spindle_ahead(&p->effects, &s->effects, m) + gained / p->gear_gain - s->contact_angle;
}

static void deform(State *s, const Parameters *p, double x, double dt, double factor)
{
    Curve at = characteristic_curve(x, p->curve);
    double travel = max(x, 0.0) - max(s->past_contact, 0.0);
    s->past_contact = x;
    double doubt = s->covariance[1][1];
    if (doubt > DOUBTFUL_RAD * DOUBTFUL_RAD)
        at.slope = mean_slope(x, sqrt(doubt), p->curve);
    double drive = static_force(&p->effects, &s->effects, factor * at.force, travel, dt);
    s->force = first_order_lag(s->force, s->drive, drive, dt, p->relaxation_time);
    s->slope = first_order_lag(s->slope, s->drive_slope, factor * at.slope, dt, p->relaxation_time);
    s->drive = drive;
    s->drive_slope = factor * at.slope;
}

static void stiffness_path(State *s, const Parameters *p, const Sample *m, double factor)
{
    double x = position(s, p, m);
    double dt = m->dt;
    if (dt > ONE_CYCLE_S) {
        dt = min(0.5 * m->dt, 2.0 * p->relaxation_time);
        deform(s, p, x - dt * m->speed, m->dt - dt, factor);
    }
    deform(s, p, x, dt, factor);
}

static double torque_path(State *s, const Parameters *p, const Sample *m, double *leverage, double *friction_variance)
{
    double travel = m->angle - s->angle;
    double slid = slid_angle(s->slid_angle, m->angle, FLICKER_RAD) - s->slid_angle;
    s->slid_angle += slid;
    Friction turned
        = friction_state(s->friction_state, s->friction_variance, slid, p->presliding_angle, DISSOLVING_PER_S, m->dt);
    double mean = turned.mean;
    s->friction_state = turned.after;
    s->friction_variance = turned.variance;
    s->friction_mean = mean;
    double mean_speed = 0.5 * (m->speed + s->speed), friction;
    double gain = gear(&p->effects, m->angle, travel, mean_speed, mean, &friction);
    *leverage = p->gear_gain * gain + p->load_friction * friction * mean;
    *friction_variance = 1.0;
    if (!m->has_current || m->dt <= 0.0 || *leverage < SELF_LOCKING * p->gear_gain)
        return NAN;
    double torque = motor_torque(&p->effects, m, p->torque_constant, travel, mean_speed, s->disc, s->temperature_known);
    double turning = p->presliding_sigma * (1.0 - mean * mean);
    *friction_variance = s->friction_variance + turning * turning;
    return torque - p->inertia * (m->speed - s->speed) / m->dt - p->offset_friction * friction * mean;
}

static void start_contact(
    State *s, const Parameters *p, const Sample *m, double force, double sigma, double leverage)
{
    double travel = force > 0.0 ? travel_at(min(force, p->maximum_force) / s->factor, p->curve) : 0.0;
    if (!isfinite(travel))
        return;
    s->contact_angle += s->past_contact - travel;
    s->past_contact = travel;
    deform(s, p, travel, LONG_S, s->factor);
    double slope = s->factor * max(characteristic_curve(max(travel, 1.0), p->curve).slope, p->curve[0]);
    double lag = p->relaxation_time * m->speed;
    double misread = 1.0 / (leverage * slope);
    for (int i = 0; i < STATES; i++)
        s->covariance[1][i] = s->covariance[i][1] = misread * s->covariance[OFFSET][i];
    double own = square(sigma / slope) + lag * lag + KNOWN_RAD * KNOWN_RAD;
    s->covariance[1][1] = own + misread * misread * s->covariance[OFFSET][OFFSET];
    start_anew(&s->contact, s->covariance[1][1]);
}

static void watch_contact(
    State *s, const Parameters *p, const Sample *m, double force_before, double torque, double leverage)
{
    Contact *c = &s->contact;
    double x = s->past_contact, doubt = sqrt(s->covariance[1][1]);
    if (p->clearance_sigma == 0.0) {
        engaged(c, x, 0.0);
        return;
    }
    double current_torque = p->torque_constant * p->current_sigma, speed_torque = p->inertia * p->speed_sigma / CYCLE_S;
    double variance = current_torque * current_torque + 2.0 * speed_torque * speed_torque;
    double sigma = sqrt(variance), current_share = current_torque * current_torque / variance;
    double limit = threshold(current_share, p->current_correlation_time, CYCLE_S);
    double predicted = leverage * 0.5 * (force_before + s->force);
    double offset = s->error[OFFSET], offset_sigma = sqrt(s->covariance[OFFSET][OFFSET]);
    int found
        = watch_closing(c, torque, predicted, s->friction_mean, sigma, limit, x, doubt, offset, offset_sigma);
    offset = clearance_level(c, sigma, offset, &offset_sigma);
    double seen = predicted + c->excess;
    if (found != NOTHING) {
        s->error[OFFSET] = offset;
        for (int i = 0; i < STATES; i++)
            s->covariance[OFFSET][i] = s->covariance[i][OFFSET] = 0.0;
        s->covariance[OFFSET][OFFSET] = offset_sigma * offset_sigma;
    }
    double noticeable = max(leverage * CLAMPED * p->maximum_force, clearly_above(c, sigma));
    if (found == TOO_EARLY) {
        start_contact(s, p, m, 0.0, p->curve[0] * UNKNOWN_RAD, leverage);
    } else if (found != NOTHING) {
        start_contact(s, p, m, max(seen, 0.0) / leverage, sigma / leverage, leverage);
    } else if (!c->confirmed && c->excess > max(predicted, noticeable)) {
        s->covariance[OFFSET][OFFSET] += seen * seen;
        double force = seen / leverage;
        double friction = (p->offset_friction + p->load_friction * force) * sqrt(s->friction_variance);
        c->level = c->samples = 0.0;
        c->engaged = true;
        start_contact(s, p, m, force, (sigma + friction) / leverage, leverage);
    }
    doubt = sqrt(s->covariance[1][1]);
    if (doubt < KNOWN_RAD)
        c->lost = false;
    engaged(c, s->past_contact, doubt);
}

static inline void along(double *h, double h0, double h1, double h2, double h3, double h4)
{
    h[0] = h0;
    h[1] = h1;
    h[2] = h2;
    h[3] = h3;
    h[4] = h4;
}

static void fuse(
    State *s, const Parameters *p, const Sample *m, double force_before, double torque, double leverage,
    double friction_variance, Estimate *out)
{
    double *x = s->error, (*P)[STATES] = s->covariance, *h = s->sensitivity;
    double softening = p->thermal.softening * s->temperature_doubt + p->thermal.softening_history * s->history_doubt;
    double relative = (p->stiffness_relative_sigma + softening) * s->force;
    double spread = sqrt(p->stiffness_sigma * p->stiffness_sigma + relative * relative);
    double current_torque = p->torque_constant * p->current_sigma;
    double decay = exp(-m->dt / p->stiffness_correlation_time), noise_decay = exp(-m->dt / p->current_correlation_time);
    double walked = p->contact_walk * p->contact_walk * m->dt;
    double drifted = square(torque_offset(p)) * m->dt / OFFSET_DRIFTS_S;
    predict_errors(
        x, P, decay, walked, TORQUE_GAIN_WALK * m->dt, noise_decay, current_torque * current_torque, drifted);
    if (m->dt > ONE_CYCLE_S) {
        double lag_error = p->relaxation_time * s->slope * (m->speed - (m->angle - s->angle) / m->dt);
        P[0][0] += square(lag_error / spread);
    }
    s->contact.prior += walked;
    double misread = p->torque_relative_sigma * p->offset_friction / (p->gear_gain * p->curve[0]);
    double offset = torque_bias(&s->contact, P[1][1], misread);
    along(h, spread, -s->slope, 0.0, 0.0, 0.0);
    out->stiffness_sigma = sqrt(variance_along(P, h) + square(s->slope * offset));
    out->innovation = out->innovation_sigma = NAN;
    double mean_force = 0.5 * (force_before + s->force);
    double friction_torque = p->offset_friction + p->load_friction * max(mean_force, 0.0);
    double unknown_speed = m->dt <= ONE_CYCLE_S ? p->speed_sigma : p->speed_sigma + fabs(m->speed) + fabs(s->speed);
    double speed_torque = p->inertia * unknown_speed / CYCLE_S;
    double white = 2.0 * speed_torque * speed_torque + friction_torque * friction_torque * friction_variance;
    double gain_error = p->torque_relative_sigma * mean_force;
    double offset_error = x[OFFSET] * x[OFFSET] + P[OFFSET][OFFSET];
    double noise = white + current_torque * current_torque;
    out->torque_sigma = sqrt((noise + offset_error) / (leverage * leverage) + gain_error * gain_error);
    if (isfinite(torque)) {
        white += square(friction_torque * s->friction_variance) / (DISSOLVING_PER_S * m->dt);
        along(h, leverage * spread, -leverage * s->slope, leverage * mean_force, 1.0, 1.0);
        double innovation = torque - leverage * mean_force;
        for (int i = 0; i < STATES; i++)
            innovation -= h[i] * x[i];
        out->innovation = innovation / leverage;
        double variance = white + variance_along(P, h);
        if (s->plausibility.verdict == AGREE && innovation * innovation < GATE * GATE * variance) {
            update_errors(x, P, s->gain, innovation, h, white);
            s->torque_age = 0.0;
        } else {
            s->torque_age += m->dt;
        }
        out->innovation_sigma = sqrt(variance) / leverage;
    } else {
        s->torque_age += m->dt;
    }
    s->contact_angle += x[1];
    s->force -= s->slope * x[1];
    x[1] = 0.0;
    along(h, spread, -s->slope, 0.0, 0.0, 0.0);
    out->force = s->force + spread * x[0];
    if (out->force < 0.0)
        out->force = 0.0;
    out->sigma = sqrt(variance_along(P, h) + square(s->slope * offset));
    out->contact_sigma = sqrt(P[1][1] + offset * offset);
}

static int64_t take_sides(State *s, const Parameters *p, const Sample *m, Estimate *out)
{
    Plausibility *c = &s->plausibility;
    double torque_of_current = p->torque_constant * m->current_q - s->error[OFFSET], sigma;
    double force = force_of_torque_alone(
        c, torque_of_current, m->has_current, m->dt, p->gear_gain, p->load_friction, p->offset_friction, &sigma);
    if (isfinite(out->innovation)) {
        double torque = torque_of_current - p->inertia * (m->speed - s->speed) / m->dt;
        double doubt
            = p->gear_gain * sqrt(out->stiffness_sigma * out->stiffness_sigma + out->torque_sigma * out->torque_sigma);
        double beyond = beyond_friction(torque, s->force, doubt, p->gear_gain, p->load_friction, p->offset_friction);
        count_doubt(c, max(beyond, fabs(out->innovation) / out->innovation_sigma));
    }
    if (s->contact.lost)
        c->doubt = 0.0;
    if (c->verdict == AGREE)
        return fabs(s->error[OFFSET]) > torque_offset(p) ? PATHS_DISAGREE : 0;
    out->source = STIFFNESS_ONLY;
    if (c->verdict == STIFFNESS_WRONG) {
        out->source = m->has_current ? TORQUE_ONLY : INVALID;
        out->force = force;
        out->sigma = sqrt(sigma * sigma + s->covariance[OFFSET][OFFSET] / (p->gear_gain * p->gear_gain));
        return PATHS_DISAGREE | STUCK;
    }
    if (c->verdict == UNDECIDED && isfinite(out->innovation))
        out->sigma = sqrt(out->sigma * out->sigma + out->innovation * out->innovation);
    return c->verdict == TORQUE_FROZEN ? PATHS_DISAGREE | STUCK : PATHS_DISAGREE;
}

static void temperatures(const State *s, Estimate *out)
{
    bool known = s->temperature_known;
    for (int side = 0; side < 2; side++) {
        out->surface[side] = known ? s->pads[side][0] : NAN;
        out->mean[side] = known ? s->mean[side] : NAN;
        for (int index = 0; index < DEPTHS; index++)
            out->depth[side][index] = known ? s->depth[side][index] : NAN;
    }
    out->disc = known ? s->disc : NAN;
}

static void step(State *s, const Parameters *p, const Sample *m, Estimate *out)
{
    if (!s->started)
        start(s, p, m);
    bool moved_zero = follow_zero(s, p, m);
    if (0.0 < m->dt && m->dt <= ONE_CYCLE_S && !moved_zero)
        watch(
            &s->plausibility, m, s->angle, s->speed, s->past_contact, sqrt(s->covariance[1][1]), s->contact.confirmed);
    heat(s, p, m);
    double force_before = s->force;
    stiffness_path(s, p, m, s->factor);
    double leverage, friction_variance;
    double torque = torque_path(s, p, m, &leverage, &friction_variance);
    if (moved_zero)
        torque = NAN;
    if (m->dt <= ONE_CYCLE_S && !frozen(&s->plausibility))
        watch_contact(s, p, m, force_before, torque, leverage);
    fuse(s, p, m, force_before, torque, leverage, friction_variance, out);
    out->stiffness_force = s->force;
    out->torque_force = NAN;
    out->ml_force = s->force;
    if (isfinite(torque)) {
        double force = isfinite(s->balance) ? (torque + s->balance) / (leverage + s->leverage) : torque / leverage;
        out->torque_force = max(force, 0.0);
        out->ml_force = maximum_likelihood(s->force, out->stiffness_sigma, out->torque_force, out->torque_sigma);
    }
    out->source = s->torque_age < 0.05 ? FUSED : STIFFNESS_ONLY;
    int64_t reasons = take_sides(s, p, m, out);
    s->angle = m->angle;
    s->speed = m->speed;
    s->balance = torque;
    s->leverage = leverage;
    s->fused = out->force;
    s->fused_sigma = out->sigma;
    out->contact_angle = s->contact_angle;
    out->stiffness_factor = s->factor;
    temperatures(s, out);
    out->mode = RUNNING;
    if (moved_zero)
        reasons |= OUT_OF_RANGE;
    if (!s->temperature_known || s->temperature_doubt > DOUBTED_K)
        reasons |= TEMPERATURE_UNCERTAIN;
    if (s->plate_stuck)
        reasons |= STUCK;
    out->engaged = s->contact.engaged;
    if (s->contact.lost || out->contact_sigma > UNCERTAIN_RAD) {
        reasons |= CONTACT_UNCERTAIN;
        if (out->stiffness_sigma > out->torque_sigma && out->source == FUSED)
            out->source = TORQUE_ONLY;
    }
    if (out->force > p->maximum_force || fabs(m->speed) > SPEED_MARGIN * p->maximum_speed)
        reasons |= OUTSIDE_RANGE;
    out->reasons = reasons;
    if (!(isfinite(out->force) && isfinite(out->sigma)))
        out->source = INVALID;
}

static void predict(const State *s, const Parameters *p, double age, Estimate *out)
{
    out->mode = s->started ? RUNNING : INIT;
    out->source = s->started && age <= SILENCE_S ? PREDICTED : INVALID;
    out->reasons = 0;
    double reached = characteristic_curve(s->past_contact + p->maximum_speed * age, p->curve).force;
    double start = characteristic_curve(s->past_contact, p->curve).force;
    double moved = min(s->factor * (reached - start), p->maximum_force);
    out->force = s->fused;
    out->sigma = sqrt(s->fused_sigma * s->fused_sigma + moved * moved);
    out->stiffness_force = out->torque_force = out->ml_force = NAN;
    out->contact_angle = s->contact_angle;
    out->contact_sigma = sqrt(s->covariance[1][1]);
    out->stiffness_factor = s->started ? s->factor : 1.0;
    out->innovation = out->innovation_sigma = NAN;
    temperatures(s, out);
}

/* pipeline.py: answer, for one brake */

void answer(const Sample *samples, int64_t count, State *state, const Parameters *p, Estimate *estimates)
{
    for (int64_t number = 0; number < count; number++) {
        const Sample *row = samples + number;
        Estimate *estimate = estimates + number;
        estimate->time_ns = row->time_ns;
        estimate->cycle = row->cycle;
        estimate->elapsed_cycles = row->elapsed_cycles;
        estimate->age_cycles = row->age_cycles;
        estimate->corner = row->corner;
        estimate->counter = row->counter;
        estimate->is_sample = !row->is_prediction;
        if (row->is_prediction)
            predict(state, p, (double)row->age_cycles * CYCLE_S, estimate);
        else
            step(state, p, row, estimate);
        estimate->reasons |= row->reasons;
        if (!state->started)
            estimate->mode = INIT;
        else if (estimate->source == INVALID)
            estimate->mode = FAULT;
        else if (estimate->reasons && estimate->mode == RUNNING)
            estimate->mode = DEGRADED;
    }
}
