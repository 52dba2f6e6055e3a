/* The estimator in C: samples of one brake as lines of numbers, estimates as lines of numbers.
 *
 *     emb-daemon compile --output kernels.so
 *     emb-daemon export --calibration config/calibration.yaml --output emb.h
 *     cc -O2 -I. -o estimate examples/estimate.c kernels.so -lm -Wl,-rpath,$PWD
 *     ./estimate <samples.txt
 *
 * A line of input: cycles since the last sample, motor angle (rad), motor speed (rad/s), motor current (A), inner and outer
 * backing plate, caliper, ambient (degC), disc speed (rad/s), pulses of the wheel, vehicle speed (m/s), park brake.
 * A line of output: force and its standard deviation (N), source, mode, reasons, mean temperature of either pad (degC).
 */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>

#include "emb.h"

int main(void) {
    emb_brake brake;
    emb_init(&brake, &emb_calibration);

    emb_sample sample = {
        .brake_torque = NAN, /* A car has no such sensor. */
        .has_current = true,
        .has_thermocouple = true,
        .has_wheel_speed = true,
        .has_wheel_pulse = true,
        .has_status = true,
    };
    emb_estimate estimate;
    int64_t cycles;
    while (scanf("%" SCNd64 "%lf%lf%lf%lf%lf%lf%lf%lf%lf%lf%lf", &cycles, &sample.angle, &sample.speed, &sample.current_q,
                 &sample.inner_backplate, &sample.outer_backplate, &sample.caliper, &sample.ambient, &sample.wheel_speed,
                 &sample.wheel_pulse, &sample.vehicle_speed, &sample.park_brake) == 12) {
        sample.dt = (double)cycles * EMB_CYCLE_S;
        if (emb_step(&brake, &sample, &estimate) != 0)
            return 1;
        /* 17 digits say exactly which number it is. */
        printf("%.17g %.17g %" PRId64 " %" PRId64 " %" PRId64 " %.17g %.17g\n", estimate.force, estimate.sigma, estimate.source,
               estimate.mode, estimate.reasons, estimate.mean[0], estimate.mean[1]);
    }
    return 0;
}
