"""Do models find the parameters of the robot that they are on in their own history?"""
